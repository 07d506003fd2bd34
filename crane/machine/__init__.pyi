from .machine import Machine as Machine
from .payload import Payload as Payload
