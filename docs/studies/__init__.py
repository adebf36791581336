"""Measurements and pictures for the pages of docs/, each a command: `python -m docs.studies.<name> --help`."""
