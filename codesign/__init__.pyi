from .adapt.train import retrain_network as retrain_network
from .eye.renderer import render as render
from .network.cost import macs as macs
from .network.supernet import Supernet as Supernet
from .train.evolution import search as search
