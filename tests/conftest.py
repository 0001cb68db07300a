"""Shape checking for the whole suite, and examples that a busy machine may draw slowly."""

import hypothesis
import jaxtyping

from tests.typecheck import functions

jaxtyping.install_import_hook("touchr1_jax", f"{functions.__module__}.{functions.__name__}")

# both judge by the clock, which a shared machine falsifies
hypothesis.settings.register_profile("shared", deadline=None, suppress_health_check=[hypothesis.HealthCheck.too_slow])
hypothesis.settings.load_profile("shared")
