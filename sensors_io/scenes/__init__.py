"""Generated tactile scenes: objects of known properties pressed by a contact solver and seen by four sensors."""

from sensors_io.scenes.cards import object_cards
from sensors_io.scenes.config import SceneConfig, config_hash
from sensors_io.scenes.protocol import contact_key, contacts, make_contact

__all__ = ["SceneConfig", "config_hash", "contact_key", "contacts", "make_contact", "object_cards"]
