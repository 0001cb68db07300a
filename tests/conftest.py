"""Shape checking for the whole suite: the shapes that functions of `touchr1_jax` annotate hold while tests run."""

import jaxtyping

from tests.typecheck import functions

jaxtyping.install_import_hook("touchr1_jax", f"{functions.__module__}.{functions.__name__}")
