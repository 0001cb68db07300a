"""Running an experiment: the command line, its runs on disk, progress."""
