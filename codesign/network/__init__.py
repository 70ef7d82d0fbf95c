"""Elastic network, cost, losses."""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from codesign.network import blur as blur
    from codesign.network import cost as cost
    from codesign.network import exported as exported
    from codesign.network import losses as losses
    from codesign.network import running as running
    from codesign.network import subnet as subnet
    from codesign.network import windows as windows
    from codesign.network.architecture import Architecture as Architecture
    from codesign.network.architecture import SearchSpace as SearchSpace
    from codesign.network.architecture import (
        canonical_architecture as canonical_architecture,
    )
    from codesign.network.architecture import check_architecture as check_architecture
    from codesign.network.architecture import (
        largest_architecture as largest_architecture,
    )
    from codesign.network.architecture import mutate_architecture as mutate_architecture
    from codesign.network.architecture import sample_architecture as sample_architecture
    from codesign.network.architecture import (
        smallest_architecture as smallest_architecture,
    )
    from codesign.network.subnet import Subnet as Subnet
    from codesign.network.supernet import Prediction as Prediction
    from codesign.network.supernet import Supernet as Supernet
    from codesign.network.supernet import (
        recalibrate_batch_norm as recalibrate_batch_norm,
    )

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "Architecture": "architecture",
        "Prediction": "supernet",
        "SearchSpace": "architecture",
        "Subnet": "subnet",
        "Supernet": "supernet",
        "canonical_architecture": "architecture",
        "blur": "",
        "check_architecture": "architecture",
        "cost": "",
        "exported": "",
        "largest_architecture": "architecture",
        "losses": "",
        "mutate_architecture": "architecture",
        "recalibrate_batch_norm": "supernet",
        "running": "",
        "sample_architecture": "architecture",
        "smallest_architecture": "architecture",
        "subnet": "",
        "windows": "",
    },
)
