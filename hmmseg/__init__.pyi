from estimation.api import identify as identify
from hmmseg.api import align as align
from hmmseg.api import decompose as decompose
from hmmseg.api import fit as fit
from hmmseg.api import segment as segment
from hmmseg.errors import InputError as InputError
from hmmseg.example import example_folder as example_folder
from hmmseg.io.rig import Rig as Rig
from hmmseg.io.task import Task as Task
from hmmseg.io.trial import Trial as Trial
from hmmseg.online.watcher import Watcher as Watcher
from hmmseg.segmentation.spans import Segmentation as Segmentation
from simgap.api import diagnose as diagnose
from simgap.api import simulate as simulate

__version__: str
