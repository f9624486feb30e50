"""Planners: searches for a sequence of actions with many candidates, which a simulator tries together.

One file per planner; :mod:`plab.runners.planners.planner` has what they share.
"""

from plab.config.families import Appearance, Family, Rule
from plab.runners.planners.cem import Cem, CemConfig
from plab.runners.planners.cmaes import Cmaes, CmaesConfig
from plab.runners.planners.mppi import Mppi, MppiConfig
from plab.runners.planners.multistart import Multistart, MultistartConfig
from plab.runners.planners.planner import PlannerConfig, PlannerRunner
from plab.runners.planners.stages import Stages, StagesConfig

__all__ = ["FAMILY"]

FAMILY = Family(
    label="a sequence of actions, searched for with many candidates",
    config=PlannerConfig,
    runner=PlannerRunner,
    ranking="score",
    batching=True,
    contact="hard",
    rules={
        "multistart": Rule(Multistart, MultistartConfig),
        "cem": Rule(Cem, CemConfig),
        "mppi": Rule(Mppi, MppiConfig),
        "cmaes": Rule(Cmaes, CmaesConfig),
        "stages": Rule(Stages, StagesConfig),
    },
    methods={
        "multistart": Appearance("Multistart", "#6699CC"),
        "cem": Appearance("CEM", "#117733", "--"),
        "mppi": Appearance("MPPI", "#44AA99", "-."),
        "cmaes": Appearance("CMA-ES", "#882255"),
        "hybrid": Appearance("Hybrid", "#AA4499", "--"),
        "solve": Appearance("Solve", "#332288"),
    },
)
