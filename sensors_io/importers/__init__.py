"""Readers of published recordings, one module per data set; each writes records and reports what it left out."""
