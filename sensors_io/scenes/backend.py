"""The devices that JAX computes on."""

import os

import jax

from sensors_io.errors import UserError

PLATFORMS = "JAX_PLATFORMS"


class BackendError(UserError, RuntimeError):
    """A platform that this machine or this installation of JAX does not have."""


def require_backend() -> None:
    """Find the devices now, before any work is done.

    Raises:
      BackendError: `JAX_PLATFORMS` names platforms of which none is there.
    """
    try:
        jax.devices()
    except (RuntimeError, AssertionError) as error:  # where no platform is left, JAX only asserts that there is one
        reason = f" ({error})" if str(error) else ""
        raise BackendError(
            f"{PLATFORMS} is {os.environ.get(PLATFORMS)!r}: must name platforms of this machine{reason}; unset it, or "
            "install JAX for that platform"
        ) from error
