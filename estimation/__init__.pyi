from estimation.actual import read_actual as read_actual
from estimation.api import identify as identify
from estimation.identification import Identification as Identification
