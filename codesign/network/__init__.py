"""Elastic network, cost, losses."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from codesign.network import blur as blur
    from codesign.network import cost as cost
    from codesign.network import exported as exported
    from codesign.network import losses as losses
    from codesign.network import running as running
    from codesign.network import subnet as subnet
    from codesign.network import windows as windows
    from codesign.network.architecture import Architecture as Architecture
    from codesign.network.architecture import Space as Space
    from codesign.network.architecture import active as active
    from codesign.network.architecture import check as check
    from codesign.network.architecture import largest as largest
    from codesign.network.architecture import mutate as mutate
    from codesign.network.architecture import sample as sample
    from codesign.network.architecture import smallest as smallest
    from codesign.network.subnet import Subnet as Subnet
    from codesign.network.supernet import Prediction as Prediction
    from codesign.network.supernet import Supernet as Supernet
    from codesign.network.supernet import recalibrate as recalibrate

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "Architecture": "architecture",
        "Prediction": "supernet",
        "Space": "architecture",
        "Subnet": "subnet",
        "Supernet": "supernet",
        "active": "architecture",
        "blur": "",
        "check": "architecture",
        "cost": "",
        "exported": "",
        "largest": "architecture",
        "losses": "",
        "mutate": "architecture",
        "recalibrate": "supernet",
        "running": "",
        "sample": "architecture",
        "smallest": "architecture",
        "subnet": "",
        "windows": "",
    },
)
