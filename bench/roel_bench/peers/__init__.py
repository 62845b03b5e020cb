"""Other methods on the same events, poses and camera: EMVS, EL-SLAM's mapping and LIMAP.

EMVS and EL-SLAM are written anew from their papers, because their code is a ROS package or was
never published; LIMAP is its authors' package, run in an environment of its own. Every peer takes
an `EventSource`, a `Trajectory` and a `Camera` and gives points or segments in the world, m.

The settings here were chosen on the tuning rooms `room_12` (346x260, seed 12) and seed 102 alone;
what was tried is told beside each of them. Rooms that results are reported for were not looked at.
"""
