"""Stage and pixel by the tags of TIFF files that are written with them."""

import math

import numpy as np
import pytest
import tifffile

from characterize.captures import capture

FRAMES = np.arange(4 * 6 * 5, dtype=np.uint16).reshape(4, 6, 5)


def load(tmp_path, frames, metadata, **options):
    tifffile.imwrite(tmp_path / "a.tif", frames, metadata=metadata, **options)
    return capture.load(tmp_path / "a.tif")


@pytest.mark.parametrize(
    ("unit", "um"),
    [
        ("nm", 1e-3),
        ("um", 1.0),
        ("micron", 1.0),
        ("mm", 1e3),
        ("cm", 1e4),
        ("inch", 25400.0),
        ("pixel", math.nan),
    ],
)
def test_imagej_gives_steps_and_pixels_in_the_unit_that_it_names(tmp_path, unit, um):
    """Pixels of 1 / 8 unit along x and 1 / 5 along y: that of x. A unit that is no
    length states nothing.
    """
    about = {"axes": "ZYX", "spacing": 2.5, "unit": unit}
    found = load(tmp_path, FRAMES, about, imagej=True, resolution=(8.0, 5.0))
    assert found.pixel_um == pytest.approx(um / 8, rel=1e-12, nan_ok=True)
    want = 2.5 * um * np.arange(4) if um > 0 else np.full(4, math.nan)
    assert found.position_um == pytest.approx(want, rel=1e-12, nan_ok=True)
    words = f"stage step of {2.5 * um:.4g} um from the ImageJ tags"
    assert (words in found.corrections) == (um > 0)


@pytest.mark.parametrize(
    ("unit", "um"), [("nm", 1e-3), ("µm", 1.0), ("mm", 1e3), (None, 1.0)]
)
@pytest.mark.parametrize("has_positions", [True, False])
def test_ome_gives_positions_or_steps_and_the_pixel_along_x(
    tmp_path, unit, um, has_positions
):
    about = {"axes": "ZYX", "PhysicalSizeX": 0.37, "PhysicalSizeY": 0.91}
    about |= {"PhysicalSizeZ": 2.5, "PhysicalSizeYUnit": "cm"}
    about |= {f"PhysicalSize{axis}Unit": unit for axis in "XZ" if unit}
    want = 2.5 * um * np.arange(4)
    if has_positions:
        units = ["mm", "um", "nm", "mm"]
        about["Plane"] = {"PositionZ": [3.5, 1.5, -2.0, 8.25], "PositionZUnit": units}
        want = [3500.0, 1.5, -2e-3, 8250.0]
    found = load(tmp_path, FRAMES, about, ome=True)
    assert found.pixel_um == pytest.approx(0.37 * um, rel=1e-12)
    assert found.position_um == pytest.approx(want, rel=1e-12)


def ome(tmp_path, text, *, pages=4):
    """A stack whose OME-XML is as given."""
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, FRAMES[:pages], ome=True, metadata={"axes": "ZYX"})
    tifffile.tiffcomment(path, text.encode())
    return capture.load(path)


def test_ome_tags_that_are_no_xml_are_reported(tmp_path):
    found = ome(tmp_path, "<OME><Pixels< PhysicalSizeZ='2.5'/></OME>")
    assert np.isnan(found.position_um).all()
    assert any("are no XML" in words for words in found.corrections)


@pytest.mark.parametrize(
    ("order", "want"), [("XYZCT", [7, 5e3, 9, 11]), ("XYCTZ", [7, 9, 5e3, 11])]
)
def test_planes_of_ome_lie_where_they_say(tmp_path, order, want):
    """Two depths, two times, listed out of order; pages by the stated order. Without
    PositionZ, or with a unit that is no length, nothing is known.
    """
    planes = "".join(
        f'<Plane TheZ="{z}" TheT="{t}" TheC="0" PositionZ="{at}" {unit}/>'
        for z, t, at, unit in (
            (0, 0, 7, ""),
            (0, 1, 9, 'PositionZUnit="&#181;m"'),
            (1, 0, 5, 'PositionZUnit="mm"'),
            (1, 1, 11, 'PositionZUnit="\u03bcm"'),
        )
    )
    text = f'<OME xmlns="http://ome"><Pixels DimensionOrder="{order}">{planes}</Pixels></OME>'
    assert ome(tmp_path, text).position_um.tolist() == want
    for strange in (
        text.replace("mm", "reference frame"),
        text.replace('"9"', '"nan"'),
    ):
        assert np.isnan(ome(tmp_path, strange).position_um).all()


@pytest.mark.parametrize("kind", ["imagej", "ome"])
def test_a_stack_of_several_times_steps_through_its_planes_each_time(tmp_path, kind):
    sizes = (
        {"spacing": 0.3, "unit": "um"}
        if kind == "imagej"
        else {"PhysicalSizeZ": 300.0, "PhysicalSizeZUnit": "nm"}
    )
    frames = np.arange(12 * 6 * 5, dtype=np.uint16).reshape(3, 4, 6, 5)
    for axes, stack, steps in (
        ("TZYX", frames, [0, 1, 2, 3] * 3),
        ("ZTYX", frames, [0] * 4 + [1] * 4 + [2] * 4),
        ("TYX", frames[0], [math.nan] * 4),
    ):
        if kind == "imagej" and axes == "ZTYX":  # it has an order of its own
            continue
        found = load(tmp_path, stack, {"axes": axes, **sizes}, **{kind: True})
        want = pytest.approx(0.3 * np.array(steps), rel=1e-12, nan_ok=True)
        assert found.position_um == want


def test_a_stack_in_a_folder_of_its_own_has_its_tags_too(tmp_path):
    """Beside a dark frame; capture.toml comes before the tags."""
    about = {"axes": "ZYX", "spacing": 2.5, "unit": "um"}
    tifffile.imwrite(tmp_path / "dark.tif", FRAMES[:2] // 9, photometric="minisblack")
    (tmp_path / "capture.toml").write_text("pixel_um = 1.7\n")
    load(tmp_path, FRAMES, about, imagej=True, resolution=(8.0, 5.0))
    found = capture.load(tmp_path)
    assert found.position_um == pytest.approx(2.5 * np.arange(4))
    assert found.pixel_um == 1.7


def test_a_plain_file_states_nothing(tmp_path):
    found = load(tmp_path, FRAMES, None, photometric="minisblack")
    assert np.isnan(found.position_um).all()
    assert math.isnan(found.pixel_um)
