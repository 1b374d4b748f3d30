from estimation.api import identify as identify
from estimation.identification import Identification as Identification
from estimation.report import read_actual as read_actual
