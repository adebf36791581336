"""Reads what strangers wrote: files of limited size, numbers of limited size, values that are short in errors."""
