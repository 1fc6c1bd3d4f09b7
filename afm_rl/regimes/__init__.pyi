from .base import Regime as Regime
from .commands import (
    DeadZone as DeadZone,
    Permutation as Permutation,
    Quantisation as Quantisation,
    Rotation as Rotation,
    Saturation as Saturation,
)
from .compose import Compose as Compose, actuator_regimes as actuator_regimes
from .flight import (
    InertiaFactor as InertiaFactor,
    MassFactor as MassFactor,
    MotorEfficiency as MotorEfficiency,
    Payload as Payload,
    Wind as Wind,
    flight_regimes as flight_regimes,
    wind_of as wind_of,
)
from .gains import (
    ActionGain as ActionGain,
    AsymmetricGain as AsymmetricGain,
    Bias as Bias,
    DeadActuator as DeadActuator,
    GainNoise as GainNoise,
)
from .ground import Patches as Patches, WheelSlip as WheelSlip
from .late import Backlash as Backlash, Delay as Delay, Lag as Lag
from .physics import Physics as Physics
from .presets import (
    Actuators as Actuators,
    presets as presets,
    servo_faults as servo_faults,
    shifted as shifted,
)
from .schedule import (
    Schedule as Schedule,
    blend_phases as blend_phases,
    phase_parameters as phase_parameters,
)
