"""`python -m sensors_io push`."""

import dataclasses
import pathlib

import tyro

from sensors_io.codec import RecordsError
from sensors_io.commands.console import OUT
from sensors_io.contents import RESTS, rest_pictures
from sensors_io.index import INDEX
from sensors_io.records import RecordStore
from sensors_io.remote import Mirror, at_url


@dataclasses.dataclass(frozen=True, kw_only=True)
class Push:
    """Upload records to a URL, from which every command reads them: gels at rest and shards first, then the index.

    A push that was interrupted goes on with the same command; what a reader sees until its end is what was there.
    """

    records: tyro.conf.Positional[pathlib.Path]
    """Directory of the records."""
    url: tyro.conf.Positional[str]
    """Such as s3://bucket/records or gs://bucket/records."""

    def run(self) -> int:
        if at_url(self.records):
            raise RecordsError(f"records are {self.records}: must be a folder on this machine; copy them there first")
        mirror, store = Mirror(self.url), RecordStore(self.records)
        rests = [f"{RESTS}/{name}" for name in rest_pictures(self.records)]
        sent = mirror.publish(self.records, [*rests, *store.files, INDEX])
        there = RecordStore(self.url)
        OUT.print(f"{len(there)} contacts at {there.path}, {sent / 1e6:.1f} MB were sent", highlight=False)
        return 0
