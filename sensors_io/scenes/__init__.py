"""Generated tactile scenes: objects of known properties pressed by a contact solver and seen by four sensors."""
