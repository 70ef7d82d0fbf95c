"""Options of ezdxf belong to the whole process: a mask leaves them as they were."""

import layout
from layout.formats.dxf import DxfWindow


def test_options_of_ezdxf_are_as_before_and_files_are_alike(plan, tmp_path):
    import ezdxf

    before = ezdxf.options.write_fixed_meta_data_for_testing
    for name in ("a.dxf", "b.dxf"):
        layout.write_dxf(plan, tmp_path / name, window=DxfWindow(0, 0, 9))
        assert ezdxf.options.write_fixed_meta_data_for_testing == before is False
    one, two = ((tmp_path / name).read_bytes() for name in ("a.dxf", "b.dxf"))
    assert one == two
