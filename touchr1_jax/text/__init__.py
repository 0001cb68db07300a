"""The answer language, its tokenizers, its template and its parser."""
