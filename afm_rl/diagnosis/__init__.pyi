from .calibration import (
    Calibration as Calibration,
    apply as apply,
    calibrate as calibrate,
    known_dynamics as known_dynamics,
    predict as predict,
    read_calibration as read_calibration,
)
from .findings import Actuator as Actuator, Change as Change, Diagnosis as Diagnosis
from .log import Log as Log
from .settings import Settings as Settings
from .verdict import diagnose as diagnose
