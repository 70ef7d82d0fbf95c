"""Checkpoints: bit for bit, refused when foreign, truncated or of other settings."""

from dataclasses import dataclass, replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from codesign.train import checkpoint
from metalens.core.errors import TrainingError


@dataclass(frozen=True)
class Settings:
    steps: int = 10
    rate: float = 0.1


leaf = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(2**70), 2**70),
    st.floats(allow_nan=False),
    st.text(max_size=8),
)
tree = st.recursive(
    leaf,
    lambda inner: st.one_of(
        st.lists(inner, max_size=3),
        st.dictionaries(st.text(max_size=4), inner, max_size=3),
    ),
)


@settings(max_examples=60)
@given(st.dictionaries(st.text(max_size=5), tree, max_size=4))
def test_any_tree_comes_back(tmp_path_factory, state):
    path = tmp_path_factory.mktemp("c") / "c.safetensors"
    checkpoint.save_checkpoint(path, state, settings=Settings())
    assert checkpoint.load_checkpoint(path, settings=Settings()) == state


def test_optimiser_continues_bit_for_bit(tmp_path):
    def fresh():
        torch.manual_seed(0)
        net = torch.nn.Linear(5, 3)
        return net, torch.optim.Adam(net.parameters(), 0.1)

    def step(net, optimiser, count):
        for _ in range(count):
            optimiser.zero_grad()
            net(torch.randn(4, 5)).square().mean().backward()
            optimiser.step()

    net, optimiser = fresh()
    step(net, optimiser, 3)
    state = {
        "net": net.state_dict(),
        "optimiser": optimiser.state_dict(),
        "random": torch.get_rng_state(),
    }
    checkpoint.save_checkpoint(tmp_path / "c", state, settings=Settings())
    step(net, optimiser, 4)
    other, other_optimiser = fresh()
    back = checkpoint.load_checkpoint(tmp_path / "c", settings=Settings())
    other.load_state_dict(back["net"])
    saved = back["optimiser"]
    moments = {int(number): row for number, row in saved["state"].items()}
    other_optimiser.load_state_dict(saved | {"state": moments})
    torch.set_rng_state(back["random"])
    step(other, other_optimiser, 4)
    assert torch.equal(net.weight, other.weight)
    assert torch.equal(net.bias, other.bias)


def test_changed_settings_are_refused_with_the_difference(tmp_path):
    checkpoint.save_checkpoint(tmp_path / "c", {"a": 1}, settings=Settings())
    with pytest.raises(TrainingError, match=r"rate: 0\.1 -> 0\.2"):
        checkpoint.load_checkpoint(
            tmp_path / "c", settings=replace(Settings(), rate=0.2)
        )


@pytest.mark.parametrize("keep", [0, 5, 60, 200])
def test_truncated_checkpoint_is_refused(tmp_path, keep):
    path = tmp_path / "c"
    checkpoint.save_checkpoint(path, {"a": torch.arange(100)}, settings=Settings())
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(TrainingError, match="truncated or not a checkpoint"):
        checkpoint.load_checkpoint(path, settings=Settings())


def test_missing_and_foreign_files_are_refused(tmp_path):
    with pytest.raises(TrainingError, match="no checkpoint"):
        checkpoint.load_checkpoint(tmp_path / "absent", settings=Settings())
    from safetensors.torch import save_file

    save_file({"x": torch.zeros(2)}, str(tmp_path / "w"))
    with pytest.raises(TrainingError, match=r"no kind.*train again"):
        checkpoint.load_checkpoint(tmp_path / "w", settings=Settings())


def test_what_cannot_be_kept_is_named(tmp_path):
    with pytest.raises(TrainingError, match="is a object"):
        checkpoint.save_checkpoint(
            tmp_path / "c", {"bad": object()}, settings=Settings()
        )
    assert not (tmp_path / "c").exists()


def _checkpointed(path, size):
    checkpoint.save_checkpoint(path, {"w": torch.ones(size)}, settings=Settings())


def test_a_full_disk_is_named_and_leaves_the_old_file(tmp_path):
    """A file-size limit stands for the disk: the write fails part-way, as on a full
    one.
    """
    import resource
    import signal

    path = tmp_path / "c"
    _checkpointed(path, 4)
    before = path.read_bytes()
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limits[1]))
    try:
        with pytest.raises(OSError, match=r"cannot be written|File too large"):
            _checkpointed(path, 100_000)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, signal.SIG_DFL)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["c"]
