"""What the simulator does not compute, because the scene or the use of it does not need it.

All of it is decided when the simulator is built or by a condition that costs next to nothing; results are
the same without, to rounding. The switches are there to measure what each saves (``python -m
plab.bench.speed --skips``) and to look for errors: switching one off only makes the simulator slower.
"""

from dataclasses import dataclass

__all__ = ["Skips"]


@dataclass(frozen=True)
class Skips:
    """What is skipped; False computes it all the same.

    Attributes:
        empty_blocks: Blocks of the grid that hold no mass.
        empty_grids: Private grids of chunks of particles that do not reach a block; CPU.
        far_manipulators: Manipulators that cannot reach a block; on CUDA a node, in the backward pass.
        rotations: Rotation of round manipulators and spin of all, where they do not rotate.
        singular_values: The decomposition into singular values where series serve.
        flow: Plastic flow of particles that do not yield; on the CPU of tiles in which none does.
        history: Keeping all states where no gradient is asked for.
        still_manipulators: Distances from, and adjoints of, manipulators that cannot move.
        adjoints: Particles' adjoints in the environment steps before a moving manipulator touches the body of
            any environment: they do not reach an action.
        launches: Launching the phases of a step one by one where one launch for all of them is faster; CUDA.
        waiting: Waiting at barriers where one thread alone is faster than a team; CPU.
    """

    empty_blocks: bool = True
    empty_grids: bool = True
    far_manipulators: bool = True
    rotations: bool = True
    singular_values: bool = True
    flow: bool = True
    history: bool = True
    still_manipulators: bool = True
    adjoints: bool = True
    launches: bool = True
    waiting: bool = True
