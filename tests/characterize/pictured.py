"""What a fit asks of a model, for toys of a few pictures: frames by index, rough and
quick forms of it.
"""

from types import SimpleNamespace

import numpy as np

from characterize.model.setting import FrameSetting

DEPTH = np.array([31e3, 22e3, 27e3, 24e3, 29e3])


class Pictured:
    """Frames of 4 x 3 pixels at five depths; a quick one sees a hundredth less of all,
    as one term of a field would.
    """

    def __init__(self, index=None, seen=1.0):
        self.seen = seen
        self.index = index = np.arange(5) if index is None else index
        self.setting = FrameSetting(
            DEPTH[index], np.zeros((len(index), 2)), np.ones(len(index)), 1.7, 4, 3
        )
        self.groups = [SimpleNamespace(index=np.arange(len(index)))]

    def only(self, index):
        return type(self)(self.index[index], self.seen)

    def rough(self, tolerance):
        return self

    def quick(self, *_part):
        return type(self)(self.index, 0.99)
