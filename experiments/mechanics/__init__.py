"""Contact, friction and what touch identifies."""
