from simgap import effects as effects
from simgap.api import diagnose as diagnose
from simgap.api import simulate as simulate
from simgap.gap.diagnose import Diagnosis as Diagnosis
from simgap.world.properties import Block as Block
from simgap.world.simulate import SimulatedTrial as SimulatedTrial
from simgap.world.virtual_model import VirtualModel as VirtualModel
