"""A vendor's SDK whose sensor is absent.  Runs in the bridge's process."""


def frames(serial):
    """No frame; says why on standard output too."""
    print("vendor banner on standard output", flush=True)  # noqa: T201
    raise RuntimeError("no such sensor")
    yield
