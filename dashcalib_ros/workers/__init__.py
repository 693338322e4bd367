"""Where stages run: child processes, or this one; with equal results."""
