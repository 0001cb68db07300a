"""Shape checking for the whole suite: every jaxtyping annotation of a function of `touchr1_jax` holds while tests run."""

import jaxtyping

from tests.typecheck import functions

jaxtyping.install_import_hook("touchr1_jax", f"{functions.__module__}.{functions.__name__}")
