"""`regil bench TABLE`: this project measured, beside others.

* ``tables`` - the command: which tables there are, and what each compares
* ``guide``, ``sensitivity``, ``success_buffer`` - guided replay; ``replay`` is what they share
* ``cells`` - what is kept and never measured twice; ``page`` - how tables are written;
  ``results`` - all that are kept, on one page
* ``rewards``, ``latency``, ``memory``, ``throughput`` - measured at once
* ``run_tables`` - tables made of many training runs, and ``runs``, which makes each run once;
  ``on_ray`` - on a cluster
* ``buffer_vs_learning``, ``trajectories`` - of runs that have ended
* ``real_time`` - control at 30 Hz while a policy is learned
* ``faults`` - kills, broken disks, hostile files: ``lives``, ``disk_faults``, ``hostile``
* ``toy`` - a learner that lives for seconds
* ``peers`` - other packages' alignments; ``machine``, ``timing`` - what it ran on, and how long
"""
