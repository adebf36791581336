"""The tasks, one module or folder each; its docstring is the page of the task."""
