"""A shard of contacts as it is written, and the cards of all objects as they are read."""

import collections
import contextlib
import pathlib
from collections.abc import Iterator, Mapping
from collections.abc import Sequence as Seq

from sensors_io.codec import CorruptRecordsError, decode_card, encode_sequence
from sensors_io.index import Index, Part
from sensors_io.remote import Mirror, Place
from sensors_io.schema import ObjectCard, SchemaError, Sequence
from sensors_io.shards import Entries, ShardWriter

RESTS = "backgrounds"
"""Folder next to the shards with pictures of the gel at rest, which sequences name in `camera`."""

_CARDS = 4096
"""Cards that stay in memory, with their views; where there are no more, they are read at once."""


class PartWriter:
    """One shard of contacts, which becomes a part of a data set when it is adopted.

    Args:
      root: directory of the data set.
      number: of the shard.
      sensors: of the data set.
    """

    def __init__(self, root: pathlib.Path, number: int, sensors: Seq[str]):
        self._root, self._number, self._sensors = root, number, sensors
        self._shard: ShardWriter | None = None
        self._contacts: list[tuple[str, int, int, str, tuple[str, ...]]] = []
        self._frames: collections.Counter[str] = collections.Counter()

    def __len__(self) -> int:
        return len(self._contacts)

    def write(self, sequences: Seq[Sequence]) -> None:
        """Append one contact.

        Raises:
          SchemaError: no sequence, no frame, different keys, or a sensor twice or unknown.
        """
        _check_contact(sequences, self._sensors)
        encoded = [encode_sequence(sequence) for sequence in sequences]  # refuses bad input before a file is made
        self._shard = self._shard or ShardWriter(self._root, "contacts", self._number)
        for data in encoded:
            self._shard.write(data)
        key = sequences[0].key
        self._contacts.append((key.object_id, key.site, key.trial, key.motion, tuple(s.sensor for s in sequences)))
        for sequence in sequences:
            self._frames[sequence.sensor] += len(sequence)

    def publish(self) -> Part:
        """The shard, in its place.

        Raises:
          SchemaError: it holds no contact.
          RecordsError: it did not reach the disk.
        """
        if self._shard is None:
            raise SchemaError(f"shard {self._number} of {self._root} holds no contact; write one first")
        row = self._shard.publish()
        shard = (int(row["number"]), int(row["entries"]), int(row["bytes"]))
        return Part(shard=shard, contacts=tuple(self._contacts), frames=dict(self._frames))


class Cards(Mapping[str, ObjectCard]):
    """Cards of all objects by id; of many objects, read when they are asked for.

    Args:
      root: of the data set.
      index: that names its objects.
    """

    def __init__(self, root: Place, index: Index):
        self._numbers = {name: n for n, name in enumerate(index.objects)}
        self._entries = Entries(root, "objects", index.object_shards)
        self._known: collections.OrderedDict[str, ObjectCard] = collections.OrderedDict()
        for name in self._numbers if len(self._numbers) <= _CARDS else ():
            self[name]

    def __len__(self) -> int:
        return len(self._numbers)

    def __iter__(self) -> Iterator[str]:
        return iter(self._numbers)

    def __contains__(self, name: object) -> bool:
        return name in self._numbers

    def __getitem__(self, name: str) -> ObjectCard:
        card = self._known.get(name)
        if card is None:
            card = self._known[name] = self._entries.decode(self._numbers[name], lambda data: _card_of(name, data))
            while len(self._known) > _CARDS:
                with contextlib.suppress(KeyError):  # another thread may have removed it
                    self._known.popitem(last=False)
        return card


def _card_of(name: str, data: bytes) -> ObjectCard:
    card = decode_card(data)
    if card.object_id != name:
        raise CorruptRecordsError(f"the card is of {card.object_id}, the index says {name}")
    return card


def convert(root: pathlib.Path, index: Index) -> bool:
    """Give an index of version 1 or 2 its tables, which its next root states; True if it had none.

    The old root is valid until then, and shards stay as they are.
    """
    if index.tables:
        return False
    index.convert(root, {name: card.split for name, card in Cards(root, index).items()})
    return True


def rest_pictures(root: Place) -> dict[str, bytes]:
    """Files with the gel at rest that are stored with records, by name.

    Raises:
      StoreError: a URL that cannot be read.
    """
    if isinstance(root, pathlib.Path):
        return {path.name: path.read_bytes() for path in sorted((root / RESTS).glob("*.png"))}
    mirror = Mirror(f"{root}/{RESTS}")
    return {name: mirror.fetch(name).read_bytes() for name in sorted(mirror.files())}


def put_rest_pictures(root: pathlib.Path, files: Mapping[str, bytes]) -> None:
    """Write such files into the folder of records."""
    for name, data in files.items():
        path = root / RESTS / name
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_suffix(".tmp")
        temporary.write_bytes(data)
        temporary.replace(path)


def _check_contact(sequences: Seq[Sequence], known: Seq[str]) -> None:
    if not sequences:
        raise SchemaError("sequences is []: a contact has at least one sequence; skip empty contacts")
    name, sensors = sequences[0].name, [sequence.sensor for sequence in sequences]
    if any(sequence.key != sequences[0].key for sequence in sequences):
        raise SchemaError(f"{name}: the sequences of a contact share one key; write them apart")
    if len(set(sensors)) != len(sensors) or not set(sensors) <= set(known):
        raise SchemaError(f"{name}: sensors are {sensors}: each once, out of {', '.join(known)}; correct the meta")
    if not all(map(len, sequences)):
        raise SchemaError(f"{name}: a sequence of no frames; drop it")
