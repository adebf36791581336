"""The tasks, one module each; a module is the page of its task."""
