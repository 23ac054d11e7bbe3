"""`regil doctor`: can this demonstration work in this environment? Said before any training.

* ``examine`` - findings, from a demonstration, an environment and a run's settings
* ``main`` - the same as a table, a page and an exit status

``examination`` asks ``pictures``, then ``episodes`` and ``rewards``, then ``search`` (other
encoders, k and horizon) and ``cost``; each says ``findings``, and ``page`` shows them.
"""

from regil_sb3.doctor.examination import examine, main

__all__ = ["examine", "main"]
