"""Base class of all errors that are meant for a user."""


class UserError(Exception):
    """Its message names the field, the value, the constraint and the fix, so that a command prints it as one line."""
