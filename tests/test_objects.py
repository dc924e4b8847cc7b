"""Objects: stand-ins, sampling, rest, and the import of meshes."""

import json
import os
import tracemalloc
import zipfile
from dataclasses import replace
from unittest import TestCase
from unittest.mock import Mock, patch

import numpy as np
import trimesh
from manifold3d import Manifold
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import ConvexHull, cKDTree

from tests.command import refused, succeeds
from tests.data import InFolder, data_dir, refuses
from xreset.demos.dexycb import read_dexycb
from xreset.errors import ObjectError, XResetError
from xreset.eval.results import read_evaluation
from xreset.geometry.shapes import (
    half_spaces,
    hull,
    plane_heights,
    shape_mesh,
    turn_of,
    winding_number,
)
from xreset.learning.run import read_run
from xreset.objects.catalogue import (
    canonical_name,
    canonical_names,
    load_object,
    load_objects,
    mesh_files,
    object_names,
)
from xreset.objects.decompose import (
    Settings,
    as_solid,
    convex_hulls,
    decompose,
    limited_hull,
)
from xreset.objects.meshes import (
    DEFAULT_DENSITY,
    add_mesh,
    import_with_notes,
    read_mesh,
)
from xreset.objects.properties import Properties
from xreset.objects.rest import rest_height, resting_orientation
from xreset.objects.sampling import bounding_box, keypoints, surface_normals, surface_points
from xreset.objects.verbs import make_shapes

Z = np.array([0.0, 0.0, 1.0])
BOX = trimesh.creation.box((0.1, 0.06, 0.04))
CUBE = trimesh.creation.box((0.1, 0.1, 0.1))
RING = trimesh.creation.annulus(0.036, 0.04, 0.02, sections=32)


def _specks(edge):
    """Text of a mesh of two small cubes that are far apart."""
    cubes = [trimesh.creation.box((edge, edge, edge)) for _ in range(2)]
    cubes[1].apply_translation((0.01, 0.004, 0.006))
    return trimesh.util.concatenate(cubes).export(file_type="obj")


def distance_to_pieces(points, pieces):
    """Signed distance to the union of convex pieces (a lower bound outside)."""
    heights = [plane_heights(np.array(points), half_spaces(piece)) for piece in pieces]
    return np.min([height.max(axis=-1) for height in heights], axis=0)


def ellipsoid():
    """[5000, 3] points of an ellipsoid."""
    directions = np.random.default_rng(0).normal(size=(5000, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True) * (0.03, 0.02, 0.01)


class Names(TestCase):
    def test_other_spellings(self):
        papers = "cheez-its soup mustard tuna spam banana pitcher powerdrill scissors"
        self.assertEqual(canonical_names(papers.split()), object_names())
        with self.assertRaisesRegex(ObjectError, "Found 3, expected the name of an object"):
            canonical_names([3])
        for name in ("035_power_drill", "power_drill", "Power Drill"):
            self.assertEqual(canonical_name(name), "035_power_drill")
        # archives have official names, and one's own mesh need not have the number
        for known in ("mustard_bottle", "Mustard bottle", "mustard"):
            self.assertEqual(canonical_name("006_mustard_bottle", [known, "1_mustard"]), known)
        for known, name in (
            ("wine_glass", "glass"),
            ("big_mug", "mug"),
            ("2nd_mug", "mug"),
            ("1_mug", "2_mug"),
        ):
            with refuses(self, "Unknown object", ObjectError, known):
                canonical_name(name, [known])
        with self.assertRaisesRegex(
            ObjectError, r"'teapot'.*003_cracker_box \(cheez-its\).*037_scissors"
        ):
            load_object("teapot")


class StandIns(TestCase):
    def test_the_command_lists_them(self):
        said = succeeds("objects list")
        self.assertRegex(said, r"003_cracker_box\W+cheez-its\W+0\.411\W+\d+x\d+x\d+\W+1 box")
        self.assertEqual([name for name in object_names() if name not in said], [])

    def test_physical(self):
        for obj in load_objects(object_names()):
            with self.subTest(obj.name):
                low, high = bounding_box(obj)
                self.assertTrue(((obj.com > low) & (obj.com < high)).all())
                moments = np.linalg.eigvalsh(obj.inertia)
                self.assertGreater(moments[0] + moments[1], moments[2])  # true of every rigid body
                self.assertLessEqual(len(obj.pieces), 8)


class Geometry(TestCase):
    def test_hull_within_a_tolerance_has_few_points(self):
        points = ellipsoid()
        few = hull(points, 5e-4)
        self.assertLessEqual(plane_heights(points, half_spaces(few)).max(), 5e-4)
        self.assertLess(len(few.geometry.vertices), 200)
        self.assertTrue((few.geometry.vertices[:, None] == points).all(axis=-1).any(axis=1).all())
        many = {"MANY_POINTS": 1000, "_SAMPLE": 900}  # without the exact hull
        with patch.multiple("xreset.geometry.shapes", **many):
            quick = hull(points, 5e-4)
        self.assertLessEqual(plane_heights(points, half_spaces(quick)).max(), 5e-4)
        self.assertLess(len(quick.geometry.vertices), 200)

    def test_hull_of_many_points_fits_a_cache(self):
        points = ellipsoid()
        with patch("xreset.geometry.shapes._HEIGHTS", 10**9):
            at_once = hull(points, 5e-5)
        tracemalloc.start()
        in_parts = hull(points, 5e-5)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert_array_equal(in_parts.geometry.vertices, at_once.geometry.vertices)
        self.assertLess(peak, 10e6)  # all heights together take 158 MB

    def test_winding_number_counts_overlaps(self):
        a = trimesh.creation.box((2, 2, 2))
        b = a.copy().apply_translation((1, 0, 0))
        both = trimesh.util.concatenate([a, b])
        points = np.array([[-0.5, 0.1, 0.2], [0.5, 0.1, 0.2], [2.5, 0.1, 0.2]])
        assert_allclose(winding_number(points, both.vertices, both.faces), [1, 2, 0], atol=1e-9)

    def test_limited_hull_has_the_vertices_that_matter_most(self):
        limited = limited_hull(ellipsoid())
        self.assertEqual(len(limited.geometry.vertices), 64)
        outside = plane_heights(ellipsoid(), half_spaces(limited)).max()
        self.assertLess(outside, 0.0011)  # 2.7 mm or more with 64 random ones


class Sampling(TestCase):
    def test_well_spread_on_the_outer_surface(self):
        obj = load_object("scissors")  # whose pieces overlap
        points = surface_points(obj, 64)
        assert_allclose(distance_to_pieces(points, obj.pieces), 0, atol=1e-4)
        assert_array_equal(points, surface_points(obj))
        larger = replace(obj, vertices=2.0 * obj.vertices)
        assert_allclose(surface_points(larger), 2.0 * points, atol=1e-3)
        points[:] = 0.0  # the caller's own
        self.assertGreater(np.abs(surface_points(obj)).max(), 0.0)
        obj = load_object("soup")
        points = surface_points(obj, 64)
        self.assertGreater(cKDTree(points).query(points, k=2)[0][:, 1].min(), 0.008)

    def test_normals_lead_out_of_the_solid(self):
        obj = load_object("scissors")
        points = surface_points(obj)
        normals = surface_normals(obj)
        assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
        assert_allclose(distance_to_pieces(points + 1e-3 * normals, obj.pieces), 1e-3, atol=3e-4)
        depth = winding_number(points - 1e-4 * normals, obj.vertices, obj.faces)
        self.assertTrue((depth > 0.5).all())

    def test_most_of_a_surface_may_be_inside(self):
        """Before, there were fewer points than were wanted, as with a machine and its parts."""
        boxes = [trimesh.creation.box((0.1 - 0.001 * k,) * 3) for k in range(60)]
        mesh = trimesh.util.concatenate(boxes)
        obj = replace(load_object("soup"), vertices=mesh.vertices, faces=mesh.faces)
        assert_allclose(np.abs(surface_points(obj)).max(axis=1), 0.05, atol=1e-9)

    def test_keypoints_are_corners_that_span_the_box(self):
        obj = load_object("scissors")
        points = keypoints(obj)
        # not coplanar: they see every rotation
        self.assertGreater(abs(np.linalg.det(points[1:] - points[0])), 1e-6)
        low, high = bounding_box(obj)
        self.assertTrue((np.isclose(points, low) | np.isclose(points, high)).all())


class Rest(TestCase):
    def test_height(self):
        obj = load_object("cheez-its")
        quats = np.array([[1, 0, 0, 0], [0.5**0.5, 0, 0.5**0.5, 0], [0, 1, 0, 0]])
        low, high = bounding_box(obj)
        assert_allclose(rest_height(obj, quats), [-low[2], high[0], high[2]], atol=1e-12)
        quats = 3 * np.random.default_rng(0).normal(size=(8, 4))
        lowest = [turn_of(quat).apply(obj.vertices)[:, 2].min() for quat in quats]
        assert_allclose(rest_height(obj, quats), np.negative(lowest), atol=1e-12)
        self.assertIsInstance(rest_height(obj, quats[0]), float)

    def test_a_stable_pose_is_balanced_over_its_base(self):
        obj = load_object("powerdrill")
        rotation = turn_of(resting_orientation(obj, Z))
        self.assertGreater(rotation.apply(Z)[2], np.cos(np.radians(5)))
        vertices = rotation.apply(obj.vertices)
        base = vertices[vertices[:, 2] < vertices[:, 2].min() + 1e-5, :2]
        edges = ConvexHull(base).equations
        self.assertLess((edges[:, :2] @ rotation.apply(obj.com)[:2] + edges[:, 2]).max(), 1e-6)
        box = load_object("cheez-its")
        shear = np.array([[1.0, 0, 2], [0, 1, 0], [0, 0, 1]])
        leaning = replace(box, vertices=box.vertices @ shear.T, com=shear @ box.com)
        for obj, up, nearest in (
            (box, [0.9, 0.1, 0.4], [1, 0, 0]),
            (box, Z, Z),
            (box, -Z, -Z),
            (leaning, Z, np.array([-1, 0, 2]) / 5**0.5),  # would fall over on its base
        ):
            quat = resting_orientation(obj, np.array(up))
            self.assertAlmostEqual(np.linalg.norm(quat), 1)
            assert_allclose(turn_of(quat).apply(nearest), Z, atol=1e-9)


class MeshImport(InFolder):
    def setUp(self):
        super().setUp()
        self.enterContext(patch.dict(os.environ, {"XRESET_CACHE": f"{self.folder}/cache"}))

    def write(self, mesh, name="thing"):
        path = self.folder / f"{name}.obj"
        mesh.export(path)
        return path

    def load(self, mesh, name="thing", facts=""):
        path = self.write(mesh, name)
        path.with_suffix(".toml").write_text(facts)
        return import_with_notes(path, name)

    def test_convex_mesh_is_one_hull_with_mass_by_density(self):
        result = self.load(BOX)
        self.assertEqual(len(result.obj.pieces), 1)
        self.assertAlmostEqual(result.obj.mass, DEFAULT_DENSITY * 0.1 * 0.06 * 0.04)
        expected = result.obj.mass / 12 * np.array([0.0052, 0.0116, 0.0136])
        assert_allclose(np.diag(result.obj.inertia), expected, rtol=1e-6)
        self.assertRegex(
            result.notes[0], "mass is unknown.*next to the mesh, in thing.toml: mass = "
        )
        self.assertEqual(result.mass_source, "500 kg/m^3")
        self.assertEqual(self.load(BOX, facts="mass = 0.2").obj.mass, 0.2)
        mug = self.load(BOX, "025_mug")
        self.assertEqual((mug.obj.mass, mug.mass_source, mug.notes), (0.118, "published (YCB)", ()))
        inside_out = self.load(
            trimesh.Trimesh(BOX.vertices, BOX.faces[:, ::-1]), facts="mass = 1.0"
        )
        self.assertRegex(*inside_out.notes, "^triangles face inwards, and were turned")
        mesh = trimesh.Trimesh(inside_out.obj.vertices, inside_out.obj.faces, process=False)
        self.assertGreater(mesh.volume, 0)

    def test_specks_far_from_a_scan_are_left_out_with_a_note(self):
        speck = trimesh.creation.icosphere(1, 0.001)
        speck.apply_translation((0.4, 0.0, 0.0))
        near = speck.copy()
        near.apply_translation((-0.34, 0.0, 0.0))
        result = self.load(BOX + speck, facts="mass = 0.2")
        self.assertEqual(result.notes, ("1 specks, up to 349 mm away from the rest, are left out",))
        assert_allclose(np.ptp(result.obj.vertices, axis=0), (0.1, 0.06, 0.04))
        self.assertEqual(self.load(BOX + near, facts="mass = 0.2").notes, ())

    def test_concave_mesh_is_cut_and_cached(self):
        first = self.load(RING).obj
        volume = sum(shape_mesh(piece).volume for piece in first.pieces)
        self.assertAlmostEqual(volume / RING.volume, 1.0, delta=0.1)
        assert_allclose(first.com, 0, atol=1e-9)
        # the hole stays open
        self.assertGreater(distance_to_pieces([0, 0, 0], first.pieces), 0.03)
        (file,) = (self.folder / "cache" / "objects").glob("*.npz")
        with patch("xreset.objects.cache.decompose", side_effect=AssertionError):
            again = self.load(RING).obj
        for a, b in zip(first.pieces, again.pieces, strict=True):
            assert_allclose(shape_mesh(a).bounds, shape_mesh(b).bounds, atol=1e-12)
        file.write_bytes(file.read_bytes()[:100])  # a damaged cache is made again
        with patch("xreset.objects.cache.decompose", return_value=decompose(BOX)) as cut:
            self.load(RING)
            self.load(RING, facts="tolerance = 0.003")  # other settings, other pieces
        self.assertEqual(cut.call_count, 2)
        with patch("xreset.objects.cache.distributions", return_value=[Mock(version="99")]):
            self.load(BOX)
        self.load(BOX)  # the cache knows the version of the cutter
        self.assertEqual(len(list(file.parent.glob("*.npz"))), 4)

    def test_pieces_whose_cutting_was_stopped_are_cached_and_still_say_so(self):
        stopped = replace(decompose(BOX), finished=False)
        with patch("xreset.objects.cache.decompose", return_value=stopped) as cut:
            notes = [self.load(RING).notes for _ in range(2)]
        self.assertEqual(cut.call_count, 1)
        self.assertIn("was stopped", notes[0][-1])
        self.assertEqual(notes[0], notes[1])

    def test_without_manifold3d_or_a_writable_cache(self):
        (self.folder / "file").write_text("")
        blocked = patch.dict(os.environ, {"XRESET_CACHE": f"{self.folder}/file"})
        homeless = patch("pathlib.Path.home", side_effect=RuntimeError("Could not determine home"))
        denied = patch("xreset.objects.cache.read_npz", side_effect=PermissionError(13, "denied"))
        for problem in (blocked, denied, homeless):
            with self.subTest(problem), patch.dict(os.environ), problem:
                if problem is homeless:
                    for name in ("XRESET_CACHE", "XDG_CACHE_HOME"):
                        os.environ.pop(name, None)
                self.load(BOX)
                self.assertEqual(len(self.load(BOX).obj.pieces), 1)
        with (
            patch.dict("sys.modules", {"manifold3d": None}),
            self.assertRaisesRegex(ObjectError, r"pip install 'xreset\[objects\]'"),
        ):
            self.load(RING)

    def test_open_meshes_are_closed_with_a_note(self):
        box = CUBE.subdivide().subdivide()
        result = self.load(trimesh.Trimesh(box.vertices, box.faces[:-1]), facts="mass = 1.0")
        self.assertIn("not closed", result.notes[0])
        assert_allclose(np.diag(result.obj.inertia), 0.01 / 6, rtol=1e-6)
        whole = RING.subdivide()
        result = self.load(trimesh.Trimesh(whole.vertices, whole.faces[1:]), facts="mass = 1.0")
        self.assertRegex(result.notes[0], r"\(1 hole, the widest \d+ mm\): its holes were filled")
        assert_allclose(result.obj.com, 0, atol=5e-4)

    def test_a_hollow_objects_mass_is_on_its_surface(self):
        mesh = trimesh.creation.icosphere(4, 0.1).apply_translation((0.1, 0.2, 0.3))
        for facts, moment in (  # 2/3 m r^2 of a shell: 0.3 kg in 4.2 l; 2/5 m r^2 of a solid
            ("mass = 0.3", 0.002),
            ("mass = 3.0", 0.012),
            ("density = 71.9", 0.0012),
        ):
            found = self.load(mesh, facts=facts).obj
            assert_allclose(np.diag(found.inertia), moment, rtol=0.01)
            assert_allclose(found.com, (0.1, 0.2, 0.3), atol=1e-6)

    def test_a_mesh_in_millimetres_with_density_and_friction(self):
        path = self.write(trimesh.creation.box((100, 60, 40)))
        out = self.folder / "objects"
        result = add_mesh(
            path, out, "brick", scale=0.001, properties=Properties(density=700, friction=0.4)
        )
        self.assertAlmostEqual(result.obj.mass, 700 * 0.1 * 0.06 * 0.04, places=6)
        self.assertEqual(result.notes, ())
        found = load_object("brick", out)
        self.assertEqual((found.friction, found.source), (0.4, result.obj.source))
        assert_allclose(np.ptp(found.vertices, axis=0), (0.1, 0.06, 0.04), atol=1e-9)
        for name, scale, words in (
            ("brick", 0.001, "there already"),
            ("other", 1.0, "millimetres"),
            ("mirrored", -0.1, "scale is -0.1, expected a number above 0"),
            ("other", 1e-6, r"0\.0001 x .* m, expected 0\.005 to 2 m.*--scale"),
            ("../other", 0.001, "cannot be an object's name"),
        ):
            self.assertRaisesRegex(ObjectError, words, add_mesh, path, out, name, scale=scale)
        self.assertEqual(sorted(p.name for p in out.iterdir()), ["brick.obj", "brick.toml"])

    def test_a_mesh_of_another_unit_is_told_by_its_density(self):
        pieces = decompose(BOX)  # of any mesh: cutting metres takes seconds
        for name, size, words in (
            (
                "006_mustard_bottle",
                (1.0, 0.6, 1.9),
                "0.603 kg are 0.529 kg/m.3; expected .* Is the",
            ),
            ("006_mustard_bottle", (0.01, 0.006, 0.019), "0.603 kg are 5.29e.05 kg/m.3"),
            ("crate", (0.6, 0.6, 0.6), "108 kg are 500 kg/m.3; expected 0.0001 to 50 kg"),
        ):
            box = trimesh.creation.box(size)
            path = self.write(box)
            self.assertRaisesRegex(ObjectError, words, import_with_notes, path, name)
            if name != "crate":  # which is light, if it is open
                path = self.write(trimesh.Trimesh(box.vertices, box.faces[:-1]))
                with patch("xreset.objects.meshes.cached_pieces", return_value=pieces):
                    self.assertRaisesRegex(ObjectError, words, import_with_notes, path, name)

    def test_a_killed_command_can_be_repeated(self):
        path = self.write(BOX)
        out = self.folder / "objects"
        with patch("xreset.objects.meshes.cached_pieces", side_effect=KeyboardInterrupt):
            self.assertRaises(KeyboardInterrupt, add_mesh, path, out, "brick")
        self.assertFalse(out.exists())  # nothing is written before the mesh is cut
        out.mkdir()
        # killed between the two files
        (out / "brick.toml").write_text("mass = 0.2\ntolerance = 0.002\n")
        add_mesh(path, out, "brick", properties=Properties(mass=0.2))
        self.assertEqual(load_object("brick", out).mass, 0.2)

    def test_the_neck_of_a_bottle_stays_free(self):
        radius = np.array([0, 0.03, 0.03, 0.014, 0.014, 0.018, 0.018, 0])
        height = np.array([0, 0, 0.14, 0.16, 0.17, 0.171, 0.18, 0.18])
        half = np.column_stack((radius, height))
        path = self.write(trimesh.creation.revolve(half, sections=24))
        plain = import_with_notes(path, "bottle")
        self.assertEqual(len(plain.obj.pieces), 1)
        self.assertRegex(plain.hollows(), r"its convex hull fills hollows up to \d\.\d mm deep")
        found = add_mesh(path, self.folder / "objects", "bottle")
        self.assertGreater(len(found.obj.pieces), 1)
        self.assertLessEqual(found.deviation, 0.002)
        self.assertEqual(found.hollows(), "")
        cut_short = replace(found, deviation=0.01)  # its tolerance is stated: that is no advice
        self.assertEqual(cut_short.hollows(), "")
        neck = [0.0205, 0, 0.157]
        self.assertGreater(distance_to_pieces(neck, found.obj.pieces), 0.001)
        self.assertLess(distance_to_pieces(neck, plain.obj.pieces), -0.003)

    def test_archives_and_gltf_are_bounded(self):
        content = self.write(BOX).read_bytes() + b"#" * (2 << 20)
        with zipfile.ZipFile(self.folder / "mesh.3mf", "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("mesh.obj", content)
        accessor = {"componentType": 5126, "type": "VEC3", "count": 10**9}
        header = {"asset": {"version": "2.0"}, "accessors": [accessor]}
        (self.folder / "huge.gltf").write_text(json.dumps(header))
        scene = trimesh.Scene()
        sphere = trimesh.creation.icosphere(subdivisions=4)
        for _ in range(100):
            scene.add_geometry(sphere, geom_name="one")
        scene.export(self.folder / "many.glb")
        for name, limit, words in (
            ("mesh.3mf", 16 << 20, "is an archive. Unpack it"),
            ("huge.gltf", 1 << 30, "takes 22888 MB"),
            ("many.glb", 16 << 20, "takes 46 MB"),
        ):
            with (
                patch("xreset.geometry.shapes.max_bytes", return_value=limit),
                refuses(self, words, ObjectError, name),
            ):
                read_mesh(self.folder / name)

    def test_the_command_puts_a_mesh_into_a_folder_and_draws_it(self):
        path = self.write(trimesh.creation.box((100, 60, 40)))
        out = self.folder / "objects"
        png = self.folder / "a.png"
        command = ("objects import", path, "--scale 0.001 --mass 0.2")
        self.assertIn("Add --out", refused(*command))
        self.assertIn("There is no no.stl.", refused("objects import no.stl"))
        self.assertRegex(
            succeeds(*command, "--out", out, "--name brick --picture", png),
            r"brick\W+0.2\W+100x60x40\W+1 hull",
        )
        self.assertTrue(png.read_bytes().startswith(b"\x89PNG"))
        self.assertIn("brick", succeeds("objects import", out))
        again = refused(*command, "--out", out, "--name brick")
        self.assertIn("choose another name or folder", again)
        refused(*command, "--out", out, "--name", "[/bold]")
        (out / "brick.toml").write_text("density = 1000.0\ntolerance = 0.001\n")
        self.assertRegex(succeeds("objects import", out), r"brick\W+0.24\W+100x60x40\W+1 ")

    def test_what_an_object_is_made_of_is_checked(self):
        path = self.write(BOX)
        for text, words in (
            ("mass = -1", "mass is -1, expected a number from 0.0001 to 50"),
            ("mass = 1\ndensity = 2", "one follows"),
            ("weight = 1", "unknown: weight"),
            ("mass", "TOML"),
        ):
            path.with_suffix(".toml").write_text(text)
            with refuses(self, words, XResetError, text):
                import_with_notes(path, "thing")

    def test_bad_meshes(self):
        obj = CUBE.export(file_type="obj")
        crossing = BOX.copy()
        crossing.vertices[0, 0] = 0.5
        square = "v 0 0 0\nv 0.1 0 0.1\nv 0 0.1 0.1\nv 0.1 0.1 0.2\nf 1 2 3\nf 2 4 3\n"
        for text, message in (
            ("", "no triangles|cannot be read"),
            (obj.replace("v ", "v nan ", 1), "finite|cannot be read"),
            (square, "flat"),
            (crossing.export(file_type="obj"), "crosses itself"),
            (CUBE.copy().apply_scale(1000).export(file_type="obj"), "millimetres"),
            (_specks(1e-4), "bad.obj: .*smaller than a cube of 0.2 mm"),
            (_specks(1.9e-4), "bad.obj: .*smaller than a cube of 0.2 mm"),
        ):
            path = self.folder / "bad.obj"
            path.write_text(text)
            with refuses(self, message, ObjectError):
                import_with_notes(path, "bad")

    def test_the_unit_is_checked_before_a_mesh_is_cut(self):
        path = self.folder / "025_mug.obj"
        mug = CUBE.copy().apply_scale(10)
        mug.update_faces(np.arange(len(mug.faces)) > 1)
        mug.export(path)
        with patch("xreset.objects.meshes.cached_pieces") as cut:
            with self.assertRaisesRegex(ObjectError, "measures 1 x 1 x 1 m, so 0.118 kg are"):
                import_with_notes(path, "025_mug")
            cut.assert_not_called()

    def test_layouts(self):
        (self.folder / "mug.STL").touch()
        with self.assertRaisesRegex(ObjectError, "no mesh in .* xreset objects import MESH --out"):
            mesh_files(self.folder)
        denied = patch("os.scandir", side_effect=PermissionError(13, "Permission denied"))
        for read in (mesh_files, read_dexycb, read_run, read_evaluation):
            with (
                denied,
                refuses(self, "Cannot read the folder .*: Permission denied", XResetError, read),
            ):
                read(self.folder)
        self.write(CUBE, "011_banana")
        for name in ("025_mug/textured", "025_mug/textured_simple", "024_bowl/textured"):
            path = self.folder / f"{name}.obj"
            path.parent.mkdir(exist_ok=True)
            CUBE.export(path)
        (self.folder / "024_bowl.toml").write_text("mass = 0.3")
        self.assertEqual(load_object("bowl", self.folder).mass, 0.3)
        (self.folder / "._011_banana.obj").touch()  # what macOS leaves on other drives
        files = ["011_banana.obj", "024_bowl/textured.obj", "025_mug/textured_simple.obj"]
        self.assertEqual(
            [*mesh_files(self.folder).values()], [self.folder / file for file in files]
        )
        with self.assertLogs("xreset.objects.meshes", "WARNING") as log:
            self.assertEqual(load_object("banana", self.folder).mass, 0.066)
            load_object("banana", self.folder)
        self.assertEqual(len(log.output), 1)  # once in a process
        self.assertIn("hollow", log.output[0])  # 66 g in a litre
        for folder, words in (
            (
                self.folder,
                r"'soup'.*011_banana.*the meshes in .* mug.STL as well.* import .*/mug.STL",
            ),
            (self.folder / "nowhere", "no folder"),
        ):
            self.assertRaisesRegex(ObjectError, words, load_object, "soup", folder)
        self.write(CUBE, "024_bowl").rename(self.folder / "024_bowl.OBJ")
        with self.assertRaisesRegex(
            ObjectError, "024_bowl.OBJ and .*textured.obj have the same name"
        ):
            mesh_files(self.folder)
        (self.folder / "024_bowl/textured.obj").unlink()
        self.assertEqual(load_object("bowl", self.folder).mass, 0.3)

    def test_a_real_can_stays_whole(self):
        obj = load_object("soup", data_dir() / "ycb")
        self.assertEqual(len(obj.pieces), 1)
        # 64 vertices are enough
        self.assertLess(distance_to_pieces(obj.vertices, obj.pieces).max(), 0.002)


class ThinWalls(InFolder):
    """Pieces keep to the surface."""

    def test_a_finger_fits_into_a_mug_and_its_handle(self):
        outline = [[0, 0], [0.04, 0], [0.04, 0.09], [0.0365, 0.09], [0.0365, 0.004], [0, 0.004]]
        cup = trimesh.creation.revolve(np.array(outline), sections=28)
        turn = trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0])
        turn[:3, 3] = 0.042, 0, 0.045
        ring = trimesh.creation.torus(
            0.024, 0.004, major_sections=24, minor_sections=8, transform=turn
        )
        bore = trimesh.creation.cylinder(0.038, 0.3, sections=28)
        mug = trimesh.boolean.union([cup, trimesh.boolean.difference([ring, bore])])
        pieces = decompose(mug)

        def sampled(mesh, count):
            return trimesh.sample.sample_surface(mesh, count, seed=1)[0]

        points = np.concatenate([sampled(shape_mesh(p), 400) for p in pieces.shapes])
        outside = points[winding_number(points, mug.vertices, mug.faces) < 0.5]
        surface = cKDTree(sampled(mug, 60000))
        # measured apart from the importer's own account
        self.assertLess(surface.query(outside)[0].max(), 0.0021)
        self.assertLess(pieces.deviation, 0.002)
        self.assertLess(len(pieces.shapes), 40)
        # the cup's inner radius is 36.5 mm
        self.assertGreater(distance_to_pieces([0, 0, 0.05], pieces.shapes), 0.030)
        # a finger of 16 mm through the handle
        self.assertGreater(distance_to_pieces([0.051, 0, 0.045], pieces.shapes), 0.008)
        self.assertAlmostEqual(pieces.volume, mug.volume, delta=1e-9)

    def test_overlapping_parts_count_once(self):
        box = trimesh.creation.box
        bar = box((0.1, 0.04, 0.04))
        cross = box((0.04, 0.1, 0.04)).apply_translation((0.0501, 0.0101, 0.0001))
        longer = box((0.06, 0.04, 0.04)).apply_translation((0.02, 0.0, 0.0001))
        space = box((0.08, 0.03, 0.03))
        cavity = space.copy()
        cavity.invert()
        hollow = trimesh.boolean.difference([bar, space])
        for name, parts, solids in (
            ("two bars", [bar, cross], [bar, cross]),
            ("one piece", [bar, longer], [bar, longer]),
            ("a hollow bar", [bar, cavity, cross], [hollow, cross]),
            ("a part inside", [bar, space], [bar]),
            ("apart", [bar, box((0.02, 0.02, 0.02)).apply_translation((0.3, 0.0, 0.0))], None),
        ):
            expected = trimesh.boolean.union(solids or parts)
            found = decompose(trimesh.util.concatenate(parts))
            with self.subTest(name):
                self.assertAlmostEqual(found.volume, expected.volume, delta=1e-10)
                assert_allclose(found.com, expected.center_mass, atol=1e-6)
                inertia = expected.moment_inertia / expected.volume
                assert_allclose(found.inertia, inertia, atol=1e-8)

    def test_parts_that_touch_are_closed(self):
        for shift in ((0.1, 0.1, 0.0), (0.1, 0.1, 0.1)):
            touching = trimesh.util.concatenate([CUBE, CUBE.copy().apply_translation(shift)])
            path = self.folder / "touching.obj"
            touching.export(path)
            mesh = read_mesh(path)
            with self.subTest(shift):
                self.assertTrue(mesh.is_volume)
                pieces = decompose(mesh)
                self.assertEqual(len(pieces.shapes), 2)
                self.assertAlmostEqual(pieces.volume, 2e-3, delta=1e-12)
                assert_allclose(pieces.com, np.array(shift) / 2, atol=1e-12)

    def test_parts_that_face_inwards_are_turned_but_for_cavities(self):
        """Before, such a handle was no piece, and a moment of inertia was below zero."""
        handle = trimesh.creation.box((0.08, 0.02, 0.02)).apply_translation((0.1, 0.0, 0.0))
        space = trimesh.creation.box((0.08, 0.08, 0.08))
        for part in (handle, space):
            part.invert()
        path = self.folder / "pan.stl"
        trimesh.util.concatenate([CUBE, handle, space]).export(path)
        volume = 0.1**3 - 0.08**3 + 0.08 * 0.02**2
        self.assertAlmostEqual(read_mesh(path).volume, volume, delta=1e-9)
        trimesh.util.concatenate([CUBE, handle]).export(path)
        found = add_mesh(path, self.folder / "out", "pan", properties=Properties(mass=1.0))
        self.assertRegex(*found.notes, "^triangles face inwards, and were turned")
        self.assertEqual(len(found.obj.pieces), 2)
        assert_allclose(found.obj.com, (0.0032 / 1.032, 0.0, 0.0), atol=1e-9)

    def test_slivers_whose_hull_is_flat_are_left_out(self):
        cube = Manifold.cube((0.1, 0.1, 0.1))
        sliver = Manifold.cube((0.138, 6e-9, 0.047))
        self.assertGreater(sliver.volume(), 3e-11)
        hulls = convex_hulls([sliver, cube])
        self.assertEqual([one.num_tri() for one in hulls], [12])
        self.assertAlmostEqual(hulls[0].volume(), 1e-3)

    def test_a_small_bridge_on_a_large_piece_is_seen(self):
        """The middle of what covers a hollow is 4 mm from its walls; a few hundred points of the plate miss it."""
        hollow = trimesh.creation.box((0.008, 0.008, 0.012)).apply_translation((0.05, 0.03, 0.01))
        plate = trimesh.boolean.difference([trimesh.creation.box((0.3, 0.3, 0.02)), hollow])
        pieces = decompose(plate)
        self.assertEqual(len(pieces.shapes), 1)
        self.assertAlmostEqual(pieces.deviation, 0.004, delta=1e-4)
        diagonal = np.linalg.norm(plate.extents)
        for depth, is_whole in ((0.0039, False), (0.0041, True)):
            # cutting may end after the first cut
            pieces = decompose(plate, Settings(hull_depth=depth / diagonal, effort=1_000))
            self.assertEqual(len(pieces.shapes) == 1, is_whole)

    def test_an_open_sheet_becomes_a_thin_wall(self):
        angle = np.linspace(0, 1.0, 6)
        arc = 0.05 * np.column_stack((np.sin(angle), 1 - np.cos(angle)))
        sheet = trimesh.creation.revolve(arc, sections=16)
        self.assertFalse(sheet.is_volume)
        solid = as_solid(sheet)
        self.assertAlmostEqual(solid.volume(), sheet.area * 0.001, delta=0.1 * sheet.area * 0.001)
        pail = CUBE.copy()
        pail.update_faces(pail.face_normals[:, 2] < 0.5)
        self.assertLess(as_solid(pail).volume(), 1e-4)
        pieces = decompose(sheet, Settings(hull_depth=0.0, tolerance=0.004))
        # 20 mm above the bottom
        self.assertGreater(distance_to_pieces([0, 0, 0.02], pieces.shapes), 0.012)
        self.assertLess(pieces.deviation, 0.004)

    def test_limits_of_pieces_and_effort(self):
        few = decompose(RING, Settings(max_pieces=3))
        self.assertLessEqual(len(few.shapes), 3)
        ring = RING.copy()
        ring.metadata["name"] = "ring"
        with self.assertLogs("xreset.objects.decompose", "WARNING") as log:
            short = decompose(ring, Settings(effort=5_000))
        self.assertRegex(*log.output, "ring is cut into convex pieces, which takes up to a minute")
        self.assertEqual((few.finished, short.finished), (True, False))
        crossing = trimesh.creation.box((0.1, 0.08, 0.06))  # few triangles, and many pieces to join
        crossing.vertices[0, 0] = 0.5
        settings = Settings(hull_depth=0.0, max_pieces=16, effort=300_000)
        self.assertFalse(decompose(crossing, settings).finished)
        for stopped in (few, short):
            self.assertGreater(stopped.deviation, 0.002)


class RandomShapes(InFolder):
    def test_shapes_are_closed_graspable_and_reproducible(self):
        nine = make_shapes(f"{self.folder}/nine", 9, seed=3)
        self.assertEqual(len({path.stem.split("_")[0] for path in nine}), 8)
        again = make_shapes(f"{self.folder}/one", 1, seed=3)
        self.assertEqual(again[0].read_bytes(), nine[0].read_bytes())
        for path in nine:
            mesh = trimesh.load_mesh(path)
            self.assertTrue(mesh.is_watertight, path)
            extents = np.sort(mesh.extents)
            self.assertLess(extents[0], 0.09, path)
            self.assertLess(extents[2], 0.24, path)
            assert_allclose(mesh.bounds.mean(axis=0), 0.0, atol=1e-9)
            self.assertIn("mass", path.with_suffix(".toml").read_text())
        self.assertNotEqual(nine[0].read_bytes(), nine[8].read_bytes())
        out = self.folder / "two"
        succeeds("objects make --out", out, "--count 2 --seed 3")
        made = sorted(path.name for path in out.glob("*.obj"))
        self.assertEqual(made, sorted(path.name for path in nine[:2]))
        self.assertEqual((out / nine[1].name).read_bytes(), nine[1].read_bytes())

    def test_a_built_in_object_joins_the_folder_as_a_mesh(self):
        out = self.folder / "shapes"
        make_shapes(out, 1)
        succeeds("objects import scissors --out", out)
        name = "037_scissors"
        self.assertEqual(object_names(out), (name, "box_0000"))
        built_in = load_object(name)
        mesh = load_object(name, out)
        self.assertAlmostEqual(mesh.mass, built_in.mass, places=4)
        assert_allclose(bounding_box(mesh), bounding_box(built_in), atol=1e-6)
        before = (out / f"{name}.obj").read_bytes()
        for words, options in (
            ("is there already", f"scissors --out {out}"),
            ("is a built-in object", f"soup --mass 1 --out {out}"),
            ("needs a folder of objects", "soup"),
            ("There is no soupy. Expected", f"soupy --out {out}"),
        ):
            with self.subTest(words):
                self.assertIn(words, " ".join(refused("objects import", options).split()))
        self.assertEqual((out / f"{name}.obj").read_bytes(), before)
        (out / f"{name}.obj").unlink()  # killed between the two files
        succeeds("objects import scissors --out", out)
        self.assertEqual((out / f"{name}.obj").read_bytes(), before)
        (out / f"{name}.obj").unlink()
        (out / f"{name}.toml").write_text("mass = 0.2")  # the user's own
        self.assertIn("is there already", refused("objects import scissors --out", out))

    def test_a_folder_is_never_overwritten(self):
        taken = self.folder / "taken"
        taken.mkdir()
        (taken / "own.txt").touch()
        for words, folder, count in (
            ("is there already", taken, 1),
            ("count is 10001", self.folder / "none", 10_001),
        ):
            self.assertRaisesRegex(XResetError, words, make_shapes, folder, count)
