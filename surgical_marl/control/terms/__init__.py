"""The controls that ship, a module each; the module's name is the control's."""
