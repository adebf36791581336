"""Reads what strangers wrote: files and numbers of limited size, fields of known types, short values in errors."""
