"""The questions of the touch bench: drawn from measured contacts, worded, checked by rules; answers read and scored."""
