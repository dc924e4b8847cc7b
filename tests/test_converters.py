"""Converters of other data sets, on files made in their formats, and MANO's kinematics on a model made for the test."""

import contextlib
import io
import json
import pickle
import runpy
import sys
import types
from pathlib import Path
from unittest import TestCase, mock

import numpy as np
import scipy.sparse
import torch
import trimesh
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import xreset
from tests.data import InFolder
from xreset.demos.hand import ORDERS
from xreset.demos.keypoints import Convention, read_keypoints

CONVERTERS = Path(__file__).resolve().parents[1] / "examples" / "converters"
AS_SCRIPT = mock.patch.object(sys, "path", [str(CONVERTERS), *sys.path])
with AS_SCRIPT:
    import mano
    import pickles

PARENTS = [-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14]
TO_MANO = np.argsort(ORDERS["mano"])
BETAS = np.linspace(-1, 1, 10)
ORIGIN = np.array((0.3, -0.2, 0.9))
"""Of the table in the other frame of reference."""


class Ch:
    pass


class Select:
    pass


Ch.__module__ = "chumpy.ch"
Select.__module__ = "chumpy.reordering"


def chumpy():
    """Modules of a package that a pickle of MANO names."""
    modules = {
        name: types.ModuleType(name) for name in ("chumpy", "chumpy.ch", "chumpy.reordering")
    }
    modules["chumpy.ch"].Ch = Ch
    modules["chumpy.reordering"].Select = Select
    return mock.patch.dict(sys.modules, modules)


def toy_model(points):
    """A hand of MANO's layout whose joints and tips at rest, with the shape BETAS, are at ``points`` [21, 3]."""
    rng = np.random.default_rng(0)
    vertices = np.zeros((778, 3))
    vertices[:16] = points[:16]
    vertices[[*mano.TIPS]] = points[16:]
    shapedirs = 0.01 * rng.normal(size=(778, 3, 10))
    weights = np.zeros((778, 16))
    weights[:, 0] = 1
    for tip, joint in zip(mano.TIPS, (15, 3, 6, 12, 9)):
        weights[tip] = np.eye(16)[joint]
    mean = 0.2 * rng.normal(size=45)
    basis = np.linalg.qr(np.column_stack((mean, rng.normal(size=(45, 44)))))[0].T
    return {
        "v_template": vertices - shapedirs @ BETAS,
        "shapedirs": shapedirs,
        "posedirs": 0.01 * rng.normal(size=(778, 3, 135)),
        "J_regressor": np.eye(16, 778),
        "weights": weights,
        "kintree_table": np.array([PARENTS, range(16)]),
        "hands_mean": mean,
        "hands_components": basis,
    }


def points_of(model, pose):
    """The keypoints of one pose [16, 3] of a model."""
    pose = np.asarray(pose, dtype=float)
    return mano.keypoints(
        model, Rotation.from_rotvec(pose[:1]), np.zeros((1, 3)), BETAS, fingers=pose[1:].reshape(1, 45)
    )[0]  # fmt: skip


class ManoTest(TestCase):
    def setUp(self):
        self.rest = np.random.default_rng(1).uniform(-0.1, 0.1, (21, 3))
        self.model = toy_model(self.rest)

    def test_a_joint_turns_what_comes_after_it(self):
        pose = np.zeros((16, 3))
        pose[2] = 0.1, 0.9, -0.4
        found = points_of(self.model | {"posedirs": np.zeros((778, 3, 135))}, pose)
        after = [3, 17]  # the index finger's last joint and its tip
        turned = Rotation.from_rotvec(pose[2]).apply(self.rest[after] - self.rest[2]) + self.rest[2]
        assert_allclose(found[after], turned, atol=1e-12)
        others = [point for point in range(21) if point not in after]
        assert_allclose(found[others], self.rest[others], atol=1e-12)

    def test_the_pose_corrects_the_skin_of_the_tips(self):
        pose = np.zeros((16, 3))
        pose[13] = 0.4, 0.0, 0.0  # the thumb, of which the index finger's tip is no part
        change = Rotation.from_rotvec(pose[13]).as_matrix() - np.eye(3)
        expected = self.model["posedirs"][mano.TIPS[1]][:, 9 * 12 : 9 * 13] @ change.ravel()
        assert_allclose(points_of(self.model, pose)[17] - self.rest[17], expected, atol=1e-12)


class Scene:
    """A hand that stays as it is and takes an object off the table, in a frame that another data set may have."""

    def __init__(self, up):
        demos = xreset.synthesize(["005_tomato_soup_can"], 1, seed=0)
        seen = demos.hand_valid
        self.frames = int(seen.sum())
        turn = Rotation.from_quat(demos.wrist_quat_wxyz[seen], scalar_first=True)
        grasp = int(np.argmax(demos.object_pos[seen, 2] > demos.object_pos[seen, 2][0] + 0.005))
        hand = demos.hand_keypoints[seen]
        self.hand = turn[grasp].inv().apply(hand[grasp] - hand[grasp, 0])
        self.wrist = hand[:, 0].astype(float)
        self.turn = turn
        self.pos = demos.object_pos[seen].astype(float)
        self.object_turn = Rotation.from_quat(demos.object_quat_wxyz[seen], scalar_first=True)
        self.in_object = self.relative(self.points, self.poses)
        self.heights = self.points[..., 2]
        # the same scene in the other frame
        W = Rotation.align_vectors([up], [[0, 0, 1]])[0] * Rotation.from_euler("z", 2.0)
        self.turn = W * self.turn
        self.object_turn = W * self.object_turn
        self.wrist = W.apply(self.wrist) + ORIGIN
        self.pos = W.apply(self.pos) + ORIGIN

    @property
    def points(self):
        """[F, 21, 3] in the order of xreset."""
        return np.einsum("fij,kj->fki", self.turn.as_matrix(), self.hand) + self.wrist[:, None]

    @property
    def poses(self):
        poses = np.tile(np.eye(4), (self.frames, 1, 1))
        poses[:, :3, :3] = self.object_turn.as_matrix()
        poses[:, :3, 3] = self.pos
        return poses

    @staticmethod
    def relative(points, poses):
        """Keypoints in the object's frame."""
        return np.einsum("fji,fkj->fki", poses[:, :3, :3], points - poses[:, None, :3, 3])


class ConverterTest(InFolder):
    """Each converter returns the motion that files of its format were made from."""

    def setUp(self):
        super().setUp()
        can = xreset.load_object("005_tomato_soup_can")
        trimesh.Trimesh(can.vertices, can.faces).export(self.folder / "can.obj")

    def scene(self, up):
        scene = Scene(up)
        at_rest = scene.hand[TO_MANO] + [0.09, 0.01, -0.02]
        self.at_rest = at_rest
        self.model = toy_model(at_rest)
        self.root = at_rest[0]
        stored = dict(self.model, J_regressor=scipy.sparse.csc_matrix(self.model["J_regressor"]))
        chosen = Select()
        chosen.a = Ch()
        chosen.a.x = np.concatenate((self.model["shapedirs"], np.ones((778, 3, 10))), axis=2)
        indices = np.arange(778 * 3 * 20).reshape(778, 3, 20)
        chosen.idxs = indices[..., :10].ravel()
        chosen.preferred_shape = (778, 3, 10)
        stored["shapedirs"] = chosen
        with chumpy():
            (self.folder / "MANO.pkl").write_bytes(pickle.dumps(stored, protocol=2))
        return scene

    def converted(self, scene, name, sequence, *options, object_name="005_tomato_soup_can"):
        """Run a converter and compare what it wrote with the scene; the file."""
        out = self.folder / "out.npz"
        command = [name, str(sequence), "--object", object_name, "--out", str(out)]
        command += [
            "--mesh",
            str(self.folder / "can.obj"),
            "--mano",
            str(self.folder / "MANO.pkl"),
            *options,
        ]
        with (
            AS_SCRIPT,
            mock.patch.object(sys, "argv", command),
            contextlib.redirect_stdout(io.StringIO()) as said,
        ):
            runpy.run_path(str(CONVERTERS / f"{name}.py"), run_name="__main__")
        order = said.getvalue().partition("--order ")[2].split()[0]
        written = dict(np.load(out))
        points = written["keypoints"][:, ORDERS[order]]
        assert_allclose(scene.relative(points, written["object_pose"]), scene.in_object, atol=1e-5)
        assert_allclose(points[..., 2], scene.heights, atol=1e-4)
        written["object"] = np.array("005_tomato_soup_can")
        np.savez(out, **written)
        demos = read_keypoints(out, Convention(order=order, units="m", frame="table", fps=30.0))
        self.assertEqual(demos.num_frames, scene.frames)
        return demos

    def test_grab(self):
        scene = self.scene((0, 0, 1))
        trimesh.Trimesh(
            self.model["v_template"] + self.model["shapedirs"] @ BETAS, [[0, 1, 2]], process=False
        ).export(self.folder / "hand.ply", vertex_normal=False)
        folder = self.folder / "grab" / "s1"
        folder.mkdir(parents=True)
        hand = {
            "global_orient": scene.turn.as_rotvec(),
            "fullpose": np.zeros((scene.frames, 45)),
            "transl": scene.wrist - self.root,
        }
        cup = {"global_orient": scene.object_turn.inv().as_rotvec(), "transl": scene.pos}
        np.savez(
            folder / "can_lift.npz",
            rhand={"params": hand, "vtemp": "hand.ply"},
            object={"params": cup, "object_mesh": "can.ply"},
            framerate=30.0,
        )
        self.converted(scene, "grab", folder / "can_lift.npz")

    def test_arctic(self):
        scene = self.scene((0, 0, 1))
        hand = {
            "rot": scene.turn.as_rotvec(),
            "pose": np.tile(-self.model["hands_mean"], (scene.frames, 1)),
            "trans": scene.wrist - self.root,
            "shape": BETAS,
        }
        np.save(self.folder / "can_grab_01.mano.npy", {"right": hand}, allow_pickle=True)
        rows = np.column_stack(
            (np.zeros(scene.frames), scene.object_turn.as_rotvec(), 1e3 * scene.pos)
        )
        np.save(self.folder / "can_grab_01.object.npy", rows)
        self.converted(scene, "arctic", self.folder / "can_grab_01.mano.npy")
        rows[-1, 0] = 0.5
        np.save(self.folder / "can_grab_01.object.npy", rows)
        with self.assertRaisesRegex(SystemExit, "lid turns by 29 degrees"):
            self.converted(scene, "arctic", self.folder / "can_grab_01.mano.npy")

    def test_oakink2(self):
        scene = self.scene((0, 1, 0))
        quats = np.zeros((scene.frames, 16, 4))
        quats[:, :, 0] = 1
        quats[:, 0] = scene.turn.as_quat(scalar_first=True)
        numbers = [100 + frame for frame in range(4 * scene.frames)]  # 120 per second
        hands = {}
        poses = {}
        for frame, number in enumerate(numbers):
            own = frame // 4
            hands[number] = {
                "rh__pose_coeffs": torch.tensor(quats[own : own + 1]),
                "rh__tsl": torch.tensor(scene.wrist[own : own + 1]),
                "rh__betas": torch.tensor(BETAS[None]),
            }
            poses[number] = scene.poses[own]
        data = {"mocap_frame_id_list": numbers, "raw_mano": hands, "obj_transf": {"O02@1": poses}}
        (self.folder / "a.pkl").write_bytes(pickle.dumps(data))
        self.converted(scene, "oakink2", self.folder / "a.pkl", object_name="O02@1")
        with self.assertRaisesRegex(SystemExit, "Choose from: O02@1"):
            self.converted(scene, "oakink2", self.folder / "a.pkl", object_name="cup")

    def test_taco(self):
        scene = self.scene((0, 0, 1))
        hands = self.folder / "Hand_Poses" / "(stir, can, bowl)" / "20231105_019"
        objects = self.folder / "Object_Poses" / "(stir, can, bowl)" / "20231105_019"
        hands.mkdir(parents=True)
        objects.mkdir(parents=True)
        np.save(objects / "tool_014.npy", scene.poses)
        frames = {}
        for frame, turn in enumerate(scene.turn.as_rotvec()):
            pose = np.concatenate((turn, np.zeros(45)))
            frames[f"{frame + 1:05}"] = {
                "hand_pose": torch.tensor(pose),
                "hand_trans": torch.tensor(scene.wrist[frame]),
            }
        (hands / "right_hand.pkl").write_bytes(pickle.dumps(frames))
        (hands / "right_hand_shape.pkl").write_bytes(
            pickle.dumps({"hand_shape": torch.tensor(BETAS)})
        )
        self.converted(scene, "taco", hands, object_name="tool_014")

    def test_hot3d(self):
        scene = self.scene((0, 0, 1))
        mean = self.model["hands_mean"]
        weights = -(self.model["hands_components"] @ mean)[:15]
        quats = scene.turn.as_quat(scalar_first=True)
        lines = []
        for frame in range(scene.frames):
            wrist = {"q_wxyz": [*quats[frame]], "t_xyz": [*(scene.wrist[frame] - self.root)]}
            hand = {"pose": [*weights], "betas": [*BETAS], "wrist_xform": wrist}
            lines.append(
                json.dumps({"timestamp_ns": 10**9 * frame // 30, "hand_poses": {"1": hand}})
            )
        (self.folder / "mano_hand_pose_trajectory.jsonl").write_text("\n".join(lines))
        table = [
            "object_uid,timestamp[ns],t_wo_x[m],t_wo_y[m],t_wo_z[m],q_wo_w,q_wo_x,q_wo_y,q_wo_z"
        ]
        quats = scene.object_turn.as_quat(scalar_first=True)
        for frame in range(scene.frames):
            numbers = [10**9 * frame // 30, *scene.pos[frame], *quats[frame]]
            table.append(",".join(["20446", *map(str, numbers)]))
            table.append(",".join(["99999", *map(str, [numbers[0], 0, 0, 0, 1, 0, 0, 0])]))
        (self.folder / "dynamic_objects.csv").write_text("\n".join(table))
        self.converted(scene, "hot3d", self.folder, object_name="20446")
        with self.assertRaisesRegex(SystemExit, "no left hand"):
            self.converted(scene, "hot3d", self.folder, "--side", "left", object_name="20446")

    def test_hocap(self):
        up = np.array((0.1, -0.8, -0.6))
        scene = self.scene(up / np.linalg.norm(up))
        camera = self.folder / "105322251564"
        camera.mkdir()
        points = scene.points
        for frame in range(scene.frames):
            np.savez(
                camera / f"label_{frame:06}.npz",
                hand_joints_3d=np.stack((points[frame], np.full((21, 3), -1.0))),
                obj_poses=np.stack((np.eye(4), scene.poses[frame])),
                obj_class_names=np.array(["G01_1", "G01_2"]),
            )
        normal = ("--up", *map(str, up))
        self.converted(scene, "hocap", camera, *normal, object_name="G01_2")
        # with the table upside down the hand would take the can into it
        with self.assertRaisesRegex(ValueError, "sinks [0-9]+ mm below its start"):
            self.converted(scene, "hocap", camera, "--up", *map(str, -up), object_name="G01_2")

    def test_ho3d(self):
        scene = self.scene((0, 0.8, 0.6))
        meta = self.folder / "ABF10" / "meta"
        meta.mkdir(parents=True)
        for frame, turn in enumerate(scene.object_turn.as_rotvec()):
            label = {
                "handJoints3D": scene.points[frame, TO_MANO],
                "objRot": turn[:, None],
                "objTrans": scene.pos[frame],
                "objName": "005_tomato_soup_can",
            }
            (meta / f"{frame:04}.pkl").write_bytes(pickle.dumps(label, protocol=2))
        label = dict.fromkeys(label)
        (meta / f"{scene.frames:04}.pkl").write_bytes(pickle.dumps(label))
        self.converted(scene, "ho3d", self.folder / "ABF10", "--up", "0", "0.8", "0.6")

    def test_a_pickle_may_name_arrays_only(self):
        path = self.folder / "x.pkl"
        path.write_bytes(b"cos\nsystem\n(S'true'\ntR.")
        with self.assertRaisesRegex(pickle.UnpicklingError, "asks for os.system"):
            pickles.load_pickle(path)


class ShortTest(TestCase):
    def test_a_converter_has_at_most_80_lines(self):
        names = {path.stem for path in CONVERTERS.glob("*.py")} - {"shared"}
        self.assertEqual(
            names,
            {"arctic", "grab", "ho3d", "hocap", "hot3d", "mano", "oakink2", "pickles", "taco"},
        )
        for name in names - {"mano", "pickles"}:
            text = (CONVERTERS / f"{name}.py").read_text()
            self.assertLessEqual(len(text.splitlines()), 80, name)
            self.assertIn("Not tried on the original files.", text, name)
