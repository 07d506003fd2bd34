from .c_sources import write_c as write_c
from .fmu_files import write_fmu as write_fmu
from .instance_program import InstanceProgram as InstanceProgram
from .ros2_control import write_ros2_control as write_ros2_control
