from .c_sources import write_c as write_c
from .instance_program import InstanceProgram as InstanceProgram
