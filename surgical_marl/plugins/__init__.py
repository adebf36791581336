"""What is swapped by a name in code: classes that ship, of installed packages, or registered by a program."""
