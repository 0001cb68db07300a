"""Generated scenes and the storage of records."""
