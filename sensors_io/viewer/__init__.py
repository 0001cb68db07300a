"""A live view in the browser: pictures, fields, force and losses of a sensor, by the standard library's server."""
