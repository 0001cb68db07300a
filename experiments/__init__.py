"""Experiments, each one Python file: `python -m experiments list` names them, `python -m experiments NAME` runs one."""
