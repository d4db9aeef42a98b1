"""Two robots map two halves of a building and share their maps over UDP on this machine.

python examples/two_replicas_over_udp.py
"""

import time

import gmmtorch as gt
from gmmtorch.team.sharing.transport.udp import UdpTransport

scans = list(gt.datasets.load("synthetic_building_2d"))
halves = scans[: len(scans) // 2], scans[len(scans) // 2 :]

robots = []
for number, half in enumerate(halves):
    m = gt.GaussianMap(robot=number)
    for scan in half:
        m.insert(scan)
    replica = gt.sharing.Replica(robot=number)
    replica.add(m)
    robots.append((replica, UdpTransport.unicast(number)))

(replica_0, transport_0), (replica_1, transport_1) = robots
transport_0.peers, transport_1.peers = [transport_1.address], [transport_0.address]

until = time.monotonic() + 20
while replica_0.digest() != replica_1.digest() and time.monotonic() < until:
    for replica, transport in robots:
        now = time.monotonic()
        transport.send(transport.robot, replica.datagrams(), now, "map")
        transport.send(transport.robot, replica.announcements(), now, "announcement")
    time.sleep(0.05)
    for replica, transport in robots:
        for _, datagram in transport.deliver(transport.robot, time.monotonic()):
            replica.receive(datagram)

for number, (replica, transport) in enumerate(robots):
    digest = replica.digest().hex()[:8]
    n = replica.map().n_components
    print(f"robot {number} holds {n:,} components, digest {digest}")
    transport.close()
