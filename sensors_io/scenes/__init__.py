"""Generated tactile scenes: objects of known properties pressed by a contact solver and seen by four sensors."""

from sensors_io.scenes.config import SceneConfig, config_hash
from sensors_io.scenes.protocol import contacts, object_cards

__all__ = ["SceneConfig", "config_hash", "contacts", "object_cards"]
