"""A layer whose answer is known: what a head makes of it can be reckoned by hand."""

from torch import nn


class Told(nn.Module):
    """Answers what it was told, whatever is asked."""

    def __init__(self, answer):
        super().__init__()
        self.answer = answer

    def forward(self, _):
        return self.answer
