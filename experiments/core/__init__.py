"""The runner and the reports of every experiment."""
