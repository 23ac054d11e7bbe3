"""`regil record --teleop`: demonstrations by hand.

* ``session`` - the episode, and the loop until a demonstration is kept
* ``window`` - what the person sees
* ``devices`` - keyboard, gamepad and SpaceMouse
"""

from regil_sb3.teleoperation.session import Session, teleoperate

__all__ = ["Session", "teleoperate"]
