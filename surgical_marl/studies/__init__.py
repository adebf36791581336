"""Measurements and pictures for the pages of docs/, each a command: `python -m surgical_marl.studies.<name> --help`."""
