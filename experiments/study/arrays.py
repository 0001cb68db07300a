"""Parameters as named arrays, the form in which they lie in an `.npz` file."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from touchr1_jax.types import Params


def flat(params: Params, prefix: str = "") -> dict[str, np.ndarray]:
    """The leaves of nested dictionaries, each named by its path joined by "/"."""
    leaves: dict[str, np.ndarray] = {}
    for name, value in params.items():
        here = f"{prefix}{name}"
        leaves |= flat(value, f"{here}/") if isinstance(value, dict) else {here: np.asarray(value)}
    return leaves


def nested(leaves: dict[str, np.ndarray]) -> Params:
    """The parameters whose leaves `flat` named."""
    tree: dict[str, Any] = {}
    for path, value in leaves.items():
        *folders, name = path.split("/")
        here = tree
        for folder in folders:
            here = here.setdefault(folder, {})
        here[name] = jnp.asarray(value)
    return tree
