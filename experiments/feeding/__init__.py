"""What accelerators ask of the cores beside them, and what those deliver."""
