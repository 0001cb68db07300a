"""`python -m experiments`: run, continue and list experiments."""

import sys

from experiments.running.runner import main

if __name__ == "__main__":
    sys.exit(main())
