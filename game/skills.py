"""How well a scripted player sees and moves, and the qualities that we record.

This module knows nothing about how a player decides.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

__all__ = ["EXPERT", "GROUNDED", "INTERMEDIATE", "NEARSIGHTED", "Skill"]


@dataclass(frozen=True)
class Skill:
    """How well a player sees and moves."""

    name: str
    speed: float  # forward on open ground, 0 to 1
    careful_speed: float  # forward while an unexplored crossing or a brink is near
    turn_noise: float  # standard deviation of the turn, in units of 30 degrees
    reaction: int  # decisions between aiming and turning
    pause_chance: float  # per decision, to stop and look
    pause_decisions: int  # longest stop
    sight_m: float  # bridges and pools are recognised this far away
    misjudge_chance: float  # per bridge or pool, to believe the wrong thing
    brink_m: float  # distance kept from lava and water
    variety: float  # how much the believed costs vary between episodes
    grounded: bool = False  # sees nothing new from a ledge or the air, and so takes ledges at its careful speed


EXPERT = Skill("expert", 1.0, 0.6, 0.05, 0, 0.004, 3, 14.0, 0.0, 1.4, 0.5)
NEARSIGHTED = replace(EXPERT, name="nearsighted", sight_m=5.0)  # as good, and acts on what short rays can tell
GROUNDED = replace(EXPERT, name="grounded", sight_m=3.5, grounded=True)  # and sees it when short rays can
INTERMEDIATE = Skill("intermediate", 0.8, 0.5, 0.25, 2, 0.03, 8, 9.0, 0.15, 0.3, 1.0)
