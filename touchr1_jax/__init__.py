"""Touch-R1 in JAX: a tactile encoder, a small multimodal language model, rewards and one jitted GRPO step."""

import importlib
from typing import Any

__version__ = "0.1.0"

_ASKING = ("load_policy", "TouchInput")


def __getattr__(name: str) -> Any:
    """The names of `asking`, imported when they are first used: no module of the package needs them."""
    if name not in _ASKING:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.asking"), name)
