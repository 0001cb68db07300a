"""Generated scenes as a data set that is nowhere stored: a contact is made when it is asked for.

    scenes = LiveScenes(SceneConfig(objects=1000, sequences=14_700))
    batches = clip_batches(scenes, scenes.contacts_of_split("train"), ClipConfig(), batch_size=16, seed=0, threads=2)

gives the clips that the same config would give from disk, without touching it.  Order, state and resuming are those of
`clip_batches`; threads generate in parallel.
"""

import functools

import numpy as np

from sensors_io.scenes.cards import object_cards
from sensors_io.scenes.config import SceneConfig
from sensors_io.scenes.protocol import contact_key, make_contact
from sensors_io.schema import SENSORS, SPLITS, ContactKey, ObjectCard, SchemaError, Sequence


class LiveScenes:
    """A data set of generated scenes; it offers what `pipeline.Contacts` asks for.

    Args:
      config: what to generate.
    """

    def __init__(self, config: SceneConfig):
        self.config = config
        self.sensors = SENSORS

    @functools.cached_property
    def objects(self) -> dict[str, ObjectCard]:
        """Cards of all objects, drawn when they are first asked for."""
        return {card.object_id: card for card in object_cards(self.config)}

    @functools.cached_property
    def contacts(self) -> tuple[ContactKey, ...]:
        """Identity of every contact; a contact that had to be replaced comes with a later trial than it says here."""
        return tuple(contact_key(self.config, i) for i in range(len(self)))

    def __len__(self) -> int:
        return self.config.contact_count

    def contact(self, i: int, *, fields: bool = True) -> dict[str, Sequence]:
        """Contact i by sensor; its fields are there in any case."""
        del fields
        return {sequence.sensor: sequence for sequence in make_contact(self.config, i)}

    def contacts_of_split(self, split: str) -> np.ndarray:
        """Indices of the contacts whose object belongs to a split, int64, ascending.

        Raises:
          SchemaError: no such split.
        """
        if split not in SPLITS:
            raise SchemaError(f"split is {split!r}: must be one of {', '.join(SPLITS)}; rename it")
        of = (self.objects[key.object_id].split for key in self.contacts)
        return np.array([i for i, one in enumerate(of) if one == split], np.int64)
