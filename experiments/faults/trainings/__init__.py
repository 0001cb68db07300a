"""Three small trainings to be disturbed: a loop of three numbers, GRPO alone, a whole study."""

PACKAGE = __name__  # the package in which the command line finds them: `main(["counting"], package=PACKAGE)`
