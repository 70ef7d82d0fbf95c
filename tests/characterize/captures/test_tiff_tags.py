"""Stage and pixel by the tags of TIFF files that are written with them."""

import math

import numpy as np
import pytest

from characterize.captures import tiff_tags

tifffile = pytest.importorskip("tifffile")
FRAMES = np.arange(4 * 6 * 5, dtype=np.uint16).reshape(4, 6, 5)


@pytest.mark.parametrize(
    ("unit", "um"),
    [
        ("nm", 1e-3),
        ("um", 1.0),
        ("micron", 1.0),
        ("mm", 1e3),
        ("cm", 1e4),
        ("inch", 25400.0),
        ("pixel", None),
    ],
)
def test_imagej_gives_steps_and_pixels_in_the_unit_that_it_names(tmp_path, unit, um):
    """Pixels of 1 / 8 unit along x and 1 / 5 along y: that of x. A unit that is no
    length tells nothing.
    """
    about = {"axes": "ZYX", "spacing": 2.5, "unit": unit}
    tifffile.imwrite(
        tmp_path / "a.tif", FRAMES, imagej=True, resolution=(8.0, 5.0), metadata=about
    )
    found = tiff_tags.read_tags(tmp_path / "a.tif")
    if um is None:
        assert (len(found.position_um), math.isnan(found.pixel_um), found.notes) == (
            0,
            True,
            (),
        )
        return
    assert found.pixel_um == pytest.approx(um / 8, rel=1e-12)
    assert found.position_um == pytest.approx(2.5 * um * np.arange(4), rel=1e-12)
    step = f"stage step of {2.5 * um:.4g} um from the ImageJ tags"
    pixel = f"pixel of {um / 8:.4g} um from the tags"
    assert found.notes == (step, f"{pixel} of the file")


@pytest.mark.parametrize(
    ("unit", "um"), [("nm", 1e-3), ("µm", 1.0), ("mm", 1e3), (None, 1.0)]
)
def test_ome_gives_positions_and_the_pixel_along_x(tmp_path, unit, um):
    about = {"axes": "ZYX", "PhysicalSizeX": 0.37, "PhysicalSizeY": 0.91}
    about |= (
        {} if unit is None else {"PhysicalSizeXUnit": unit, "PhysicalSizeYUnit": "cm"}
    )
    planes = {
        "PositionZ": [3.5, 1.5, -2.0, 8.25],
        "PositionZUnit": ["mm", "um", "nm", "mm"],
    }
    tifffile.imwrite(
        tmp_path / "a.ome.tif", FRAMES, ome=True, metadata=about | {"Plane": planes}
    )
    found = tiff_tags.read_tags(tmp_path / "a.ome.tif")
    assert found.pixel_um == pytest.approx(0.37 * um, rel=1e-12)
    assert found.position_um == pytest.approx([3500.0, 1.5, -2e-3, 8250.0], rel=1e-12)
    assert found.notes == (f"pixel of {0.37 * um:.4g} um from the tags of the file",)


@pytest.mark.parametrize(("unit", "um"), [("nm", 1e-3), ("mm", 1e3), (None, 1.0)])
def test_ome_without_positions_gives_steps_of_the_height_of_a_voxel(tmp_path, unit, um):
    about = {"axes": "ZYX", "PhysicalSizeX": 0.37, "PhysicalSizeZ": 2.5}
    about |= {} if unit is None else {"PhysicalSizeZUnit": unit}
    tifffile.imwrite(tmp_path / "a.ome.tif", FRAMES, ome=True, metadata=about)
    found = tiff_tags.read_tags(tmp_path / "a.ome.tif")
    assert found.position_um == pytest.approx(2.5 * um * np.arange(4), rel=1e-12)
    assert found.notes[0] == f"stage step of {2.5 * um:.4g} um from the OME tags"


def test_ome_tags_that_are_no_xml_are_told(tmp_path):
    tifffile.imwrite(
        tmp_path / "a.ome.tif",
        FRAMES,
        ome=True,
        metadata={"axes": "ZYX", "PhysicalSizeZ": 2.5},
    )
    words = tifffile.tiffcomment(tmp_path / "a.ome.tif").replace("<Pixels", "<Pixels<")
    tifffile.tiffcomment(tmp_path / "a.ome.tif", words.encode())
    found = tiff_tags.read_tags(tmp_path / "a.ome.tif")
    assert (len(found.position_um), "are no XML" in found.notes[0]) == (0, True)


@pytest.mark.parametrize("kind", ["imagej", "ome"])
def test_a_stack_that_is_seen_several_times_steps_through_its_planes_each_time(
    tmp_path, kind
):
    sizes = (
        {"spacing": 0.3, "unit": "um"}
        if kind == "imagej"
        else {"PhysicalSizeZ": 300.0, "PhysicalSizeZUnit": "nm"}
    )
    frames = np.arange(12 * 6 * 5, dtype=np.uint16).reshape(3, 4, 6, 5)
    for axes, stack, steps in (
        ("TZYX", frames, [0, 1, 2, 3] * 3),
        ("ZTYX", frames, [0] * 4 + [1] * 4 + [2] * 4),
        ("TYX", frames[0], []),
    ):
        if kind == "imagej" and axes == "ZTYX":  # it has an order of its own
            continue
        tifffile.imwrite(
            tmp_path / "a.tif", stack, metadata={"axes": axes, **sizes}, **{kind: True}
        )
        assert tiff_tags.read_tags(tmp_path / "a.tif").position_um == pytest.approx(
            0.3 * np.array(steps), rel=1e-12
        )


def test_a_plain_file_tells_nothing(tmp_path):
    tifffile.imwrite(
        tmp_path / "a.tif", FRAMES, photometric="minisblack", metadata=None
    )
    found = tiff_tags.read_tags(tmp_path / "a.tif")
    assert (len(found.position_um), found.notes) == (0, ())
    assert math.isnan(found.pixel_um)
