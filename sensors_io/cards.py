"""Cards of objects that are recorded already, given labels and splits afterwards: all of them or none."""

import os
import pathlib
from collections.abc import Callable, Iterable, Mapping

from sensors_io.codec import encode_card
from sensors_io.contents import Cards, convert
from sensors_io.index import Index
from sensors_io.locks import write_lock
from sensors_io.schema import ObjectCard, SchemaError
from sensors_io.shards import ShardWriter, shard_file


def replace_cards(
    path: str | os.PathLike[str],
    cards: Iterable[ObjectCard] | Callable[[Mapping[str, ObjectCard]], Iterable[ObjectCard]],
) -> None:
    """Put cards in the place of those with the same ids; contacts stay as they are.

    One new shard holds the cards of all objects; the index that names it replaces the old one in one step, and only
    then the old shards go: a killed process leaves the old cards or the new ones.

    Args:
      path: directory of the records.
      cards: the new ones, or a function of the old ones, which no other process changes in the meantime.

    Raises:
      SchemaError: a card of an object that the records do not hold.
      RecordsError: records that are missing, damaged, or being written.
    """
    root = pathlib.Path(path)
    Index.read(root)  # before a lock file is made where there are no records
    with write_lock(root):
        index = Index.read(root)
        known = dict(Cards(root, index).items())
        new = {card.object_id: card for card in (cards(known) if callable(cards) else cards)}
        strange = sorted(set(new) - set(known))
        if strange:
            raise SchemaError(
                f"object_id is {strange[0]!r}: {root} holds {_some(known)}; correct it or record it first"
            )
        convert(root, index)
        old, every = index.object_shards, {**known, **new}
        shard = ShardWriter(root, "objects", index.next_objects)
        for card in every.values():
            shard.write(encode_card(card))
        before = [index.tables[name].file for name in ("objects", "object-shards")]
        index.replace_objects(root, shard.publish(), {name: card.split for name, card in every.items()})
        index.write(root)
        for file in (*(shard_file("objects", number) for number in old["number"]), *before):
            (root / file).unlink()


def _some(names: Iterable[str], most: int = 8) -> str:
    """The first few names."""
    listed = list(names)
    return ", ".join(listed[:most]) + (f" and {len(listed) - most} more" if len(listed) > most else "")
