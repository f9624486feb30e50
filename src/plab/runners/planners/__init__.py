"""Planners: searches for an action sequence with many candidates, simulated in one batch.

:mod:`plab.runners.planners.planner` has their common base.
"""

from plab.config.families import Appearance, Family, Rule
from plab.runners.planners.planner import PlannerConfig, PlannerRunner, Stages, StagesConfig
from plab.runners.planners.searches import (
    Cem,
    CemConfig,
    Cmaes,
    CmaesConfig,
    Mppi,
    MppiConfig,
    Multistart,
    MultistartConfig,
)

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
