"""Shape checking for the whole suite: every jaxtyping annotation of `touchr1_jax` is enforced while tests run."""

import jaxtyping

jaxtyping.install_import_hook("touchr1_jax", "tests.typecheck.functions")
