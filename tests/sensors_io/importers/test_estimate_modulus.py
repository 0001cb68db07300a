"""EstimateModulus: one force per frame, pressing negative here, and nothing where the numbers do not fit."""

import pickle

import numpy as np

from sensors_io.importers.estimate_modulus import list_estimate_modulus
from sensors_io.importers.keep import ImportConfig
from tests.sensors_io.importers.films import EVERYTHING, film, imported


def grasp(folder, name="golf_ball_1", force=None, width=None):
    folder.mkdir(parents=True, exist_ok=True)
    film(folder / f"{name}.avi", 12, rate=30.0)
    for what, values in (("forces", force), ("widths", width)):
        if values is not None:
            (folder / f"{name}_{what}.pkl").write_bytes(pickle.dumps(np.asarray(values)))
    return folder


def test_a_known_grasp_presses(tmp_path):
    grasp(tmp_path / "in" / "2023-12-06", force=np.linspace(-0.1, 24, 12), width=np.linspace(0.05, 0.04, 12))
    three = ImportConfig(max_frames=3, val_share=0, test_share=0)
    report, store = imported(list_estimate_modulus(tmp_path / "in", three), tmp_path / "out")
    assert (report.contacts, report.skipped) == (1, ())
    sequence, kept = store.contact(0)["gelsight_wedge"], [0, 6, 11]
    np.testing.assert_allclose(sequence.force_n[:, 2], -np.linspace(-0.1, 24, 12)[kept], atol=1e-3)
    assert not sequence.force_n[:, :2].any()
    np.testing.assert_allclose(sequence.camera["gripper_width_m"], np.linspace(0.05, 0.04, 12)[kept])
    np.testing.assert_allclose(sequence.host_time_ns, np.array(kept) / 30 * 1e9, atol=1)
    assert (sequence.key.object_id, sequence.key.motion) == ("golf_ball", "press")


def test_grasps_whose_files_do_not_fit_are_left_out_by_name(tmp_path):
    source = tmp_path / "in"
    grasp(source, "ball_1", force=np.ones(12))
    grasp(source, "ball_2", force=np.ones(11))
    grasp(source, "ball_3")
    grasp(source, "ball_4", force=["a"] * 12)
    grasp(source, "ball_1_other")
    grasp(source, "nameless", force=np.ones(12))
    grasp(source, "ball_5", force=np.ones(12))
    (source / "ball_5.avi").unlink()
    report, store = imported(list_estimate_modulus(source, EVERYTHING), tmp_path / "out")
    assert len(store) == 1
    videos = {f"{name}.avi" for name in ("ball_1_other", "nameless", "ball_2", "ball_3", "ball_4")}
    assert {skip.name for skip in report.skipped} == {*videos, "ball_1_widths.pkl", "ball_5_forces.pkl"}
    assert "gripper_width_m" not in store.contact(0)["gelsight_wedge"].camera
