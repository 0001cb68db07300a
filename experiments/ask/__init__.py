"""Asking trained policies about new touches: in the terminal, as JSON, on a page, in the browser."""
