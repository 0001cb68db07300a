"""FeelAnyForce: pictures with forces; the sign of pressing is inferred from a push, or stated."""

import dataclasses

import numpy as np
import pytest

from sensors_io.importers.feelanyforce import FeelAnyForceConfig, list_feelanyforce, pressing_sign
from sensors_io.schema import Flag
from tests.sensors_io.importers.films import imported, picture

KEEP = FeelAnyForceConfig(height=0, max_frames=0, val_share=0, test_share=0)
HEAD = "tactile,depth,FT\n"


def row(root, ms, reading, indenter="sphere", write=True):
    name = f"records/{indenter}/tactile/{ms}.png"
    if write:
        picture(root / name, ms % 200)
    return f"{name},records/{indenter}/depth/{ms}.npy,{reading}\n"


def write(root, *rows):
    root.mkdir(exist_ok=True)
    (root / "20250414.csv").write_text(HEAD + "".join(rows))
    return root


def feel(source, out, config=KEEP):
    return imported(list_feelanyforce(source, config), out)


@pytest.mark.parametrize(("pushes", "sign"), [("4.5", -1), ("-4.5", 1)])
def test_a_known_push_presses_whatever_sign_the_file_has(tmp_path, pushes, sign):
    """1 N along x and 4.5 N of pressing, as a sensor says that measures the push or its reaction."""
    root = tmp_path / "in"
    source = write(root, row(root, 1000, "0 0 0.1 0 0 0"), row(root, 2500, f"1 0 {pushes} 0 0 0.2"))
    _, store = feel(source, tmp_path / "out")
    sequence = store.contact(0)["gelsight_mini"]
    np.testing.assert_allclose(sequence.force_n, [[0, 0, sign * 0.1], [sign, 0, -4.5]], atol=1e-3)
    assert sequence.host_time_ns.tolist() == [1_000_000_000, 2_500_000_000]
    assert sequence.moment_nmm is None


@pytest.mark.parametrize(
    ("readings", "stated", "sign"),
    [([0.15, -0.1], "infer", 1), ([0.1, 9.0, -2.0], "infer", -1), ([9.0], "negative", 1), ([-9.0], "positive", -1)],
)
def test_the_sign_can_be_stated_and_is_left_alone_without_a_push(readings, stated, sign):
    assert pressing_sign(readings, stated) == sign


def test_rows_without_a_force_or_a_picture_are_counted(tmp_path):
    root = tmp_path / "in"
    readings = {1000: "0 0 -3 0 0 0", 2000: "", 3000: "0 0 -3 0 0", 4000: "0 0 nan 0 0 0", 5000: "0 0 -3 0 0 0"}
    rows = [row(root, ms, reading, write=ms not in (2000, 5000)) for ms, reading in readings.items()]
    rows += ["records/sphere/tactile/background.png,,0 0 0 0 0 0\n", row(root, 6000, "0 0 -2 0 0 0")]
    picture(elsewhere := tmp_path / "sphere" / "tactile" / "7000.png", 0)
    rows.append(f"{elsewhere},,0 0 -2 0 0 0\n")
    rows.append(row(root, 10**13, "0 0 -2 0 0 0"))  # beyond 64 bits in ns
    report, store = feel(write(root, *rows), tmp_path / "out")
    lines = {f"20250414.csv, line {n}" for n in (3, 4, 5, 7, 9, 10)}
    assert {skip.name for skip in report.skipped} == {*lines, "tactile/5000.png"}
    sequence = store.contact(0)["gelsight_mini"]
    assert sequence.force_n[:, 2].tolist() == [-3, 0, 0, -2]
    assert sequence.flags.tolist() == [0, int(Flag.INCOMPLETE), int(Flag.INCOMPLETE), int(Flag.TIME_GAP)]


def test_a_table_is_cut_into_pieces_and_nothing_is_lost(tmp_path):
    root = tmp_path / "in"
    rows = [row(root, 1000 * n, f"0 0 -{n} 0 0 0", "cube" if n % 2 else "ball") for n in range(1, 8)]
    report, store = feel(write(root, *rows), tmp_path / "out", dataclasses.replace(KEEP, max_frames=3))
    assert report.contacts == 3
    pieces = {(k.object_id, k.trial): store.contact(i)["gelsight_mini"] for i, k in enumerate(store.contacts)}
    forces = {key: sequence.force_n[:, 2].tolist() for key, sequence in pieces.items()}
    assert forces == {("cube", 0): [-1, -3, -5], ("cube", 1): [-7], ("ball", 0): [-2, -4, -6]}


def test_a_table_with_a_byte_order_mark_is_read_and_what_macos_writes_beside_it_is_not(tmp_path):
    source = write(tmp_path / "in", row(tmp_path / "in", 1000, "0 0 4.5 0 0 0"))
    table = source / "20250414.csv"
    table.write_bytes(b"\xef\xbb\xbf" + table.read_bytes())
    (source / f"._{table.name}").write_bytes(b"of macOS")
    report, _ = feel(source, tmp_path / "out")
    assert (report.contacts, report.skipped) == (1, ())
