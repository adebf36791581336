"""Read data of strangers: files and numbers of limited size, fields of known types, short values in errors."""
