from .findings import Actuator as Actuator, Change as Change, Diagnosis as Diagnosis
from .live import explain as explain
from .log import Log as Log
from .settings import Settings as Settings
from .verdict import diagnose as diagnose
