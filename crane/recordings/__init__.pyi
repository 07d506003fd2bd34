from .limit_cycle_detection import limit_cycles as limit_cycles
from .measured_recordings import read_measured as read_measured
from .recording import Recording as Recording
from .recording_reader import shift_columns as shift_columns
