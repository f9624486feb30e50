"""Types of the configuration: which keys there are, of which type and in which range.

The values are in ``conf/*.yaml``; the dataclasses have no defaults of their own, except for what a YAML may
leave out.
"""

from plab.config_types.method import (
    CONTACTS,
    DEVICES,
    ApgConfig,
    MethodConfig,
    OffPolicyConfig,
    PpoConfig,
    RlConfig,
    SacConfig,
    Td3Config,
    TrajectoryConfig,
)
from plab.config_types.planners import (
    CemConfig,
    CmaesConfig,
    MppiConfig,
    MultistartConfig,
    PlannerConfig,
    SamplerConfig,
    StagesConfig,
)
from plab.config_types.run import PRECISIONS, Config, ProtocolConfig, SimConfig, TargetsConfig
from plab.config_types.task import (
    BodyConfig,
    DrawConfig,
    ManipulatorConfig,
    RandomConfig,
    RangeConfig,
    TaskConfig,
)

__all__ = [
    "CONTACTS",
    "DEVICES",
    "PRECISIONS",
    "ApgConfig",
    "BodyConfig",
    "CemConfig",
    "CmaesConfig",
    "Config",
    "DrawConfig",
    "ManipulatorConfig",
    "MethodConfig",
    "MppiConfig",
    "MultistartConfig",
    "OffPolicyConfig",
    "PlannerConfig",
    "PpoConfig",
    "ProtocolConfig",
    "RandomConfig",
    "RangeConfig",
    "RlConfig",
    "SacConfig",
    "SamplerConfig",
    "SimConfig",
    "StagesConfig",
    "TargetsConfig",
    "TaskConfig",
    "Td3Config",
    "TrajectoryConfig",
]
