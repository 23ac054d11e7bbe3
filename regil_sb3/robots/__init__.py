"""Robots: what an environment needs of a camera and an arm, drivers, and a robot to rehearse with.

* ``interfaces`` - the protocols of camera, arm and clock, and what goes wrong with them
* ``limits`` - how far, how fast and where the hand may go, below any policy
* ``episodes`` - every episode on disk, whatever happens
* ``cameras``, ``arms``, ``ros`` - drivers; each imports its library when it is made
* ``operator`` - a person at the keyboard: success, abort, pause; ``regil record`` moves the hand
* ``rehearsal`` - a simulated robot in a process of its own

The environment is ``regil_sb3.envs.robot.RobotEnv``. Nothing here imports a driver's library,
a simulator or torch until it is used.
"""
