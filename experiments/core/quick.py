"""Programs that run a few times only are compiled quickly: compiling them well would take longer than running them."""

import contextlib
import os
from collections.abc import Iterator

import jax

OLDER_LOOPS = "--xla_cpu_use_fusion_emitters=false" if jax.__version_info__ < (0, 11) else ""
"""Flag of XLA: of its two ways to write a fused loop the older one, as long as there is one, compiles twice as fast."""

FLAGS = "XLA_FLAGS"
"""Environment variable that XLA reads when it compiles its first program, and never again."""


@contextlib.contextmanager
def compiled_quickly() -> Iterator[None]:
    """Leave out most of XLA's optimisations inside the block: a training step compiles in a quarter of the time.

    What such a program computes is the same up to rounding; how fast it runs says nothing about others.  The older
    loops stay chosen for the whole process where its first program is compiled inside the block.
    """
    flags, before = os.environ.get(FLAGS), jax.config.values["jax_disable_most_optimizations"]
    if OLDER_LOOPS not in (flags or ""):
        os.environ[FLAGS] = f"{flags or ''} {OLDER_LOOPS}".strip()
    jax.config.update("jax_disable_most_optimizations", True)
    try:
        yield
    finally:
        jax.config.update("jax_disable_most_optimizations", before)
        if flags is None:
            os.environ.pop(FLAGS, None)
        else:
            os.environ[FLAGS] = flags
