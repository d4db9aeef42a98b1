"""A planning round: the robots of a simulated team plan together, or one robot plans by itself."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import torch

from gmmtorch.team.exploration.mission.options import TeamOptions
from gmmtorch.team.exploration.planning.coordination import Coordination, PeerTrajectories, predicted_path
from gmmtorch.team.exploration.planning.planner_interface import Plan
from gmmtorch.team.exploration.robot.agent import Agent


def plan_together(
    agents: Sequence[Agent],
    coordination: Coordination,
    options: TeamOptions,
    now: float,
    number: int,
    generator: torch.Generator,
) -> dict[int, Plan]:
    """Makes and follows the next plan of every robot of a simulated team.

    A robot sends its final plan before the robots that plan after it listen; they wait for it as long as the
    network takes.

    Args:
        agents: sorted by robot id. number: of the planning round. generator: for the coordination's draws.

    Returns the plans by robot id, in the order in which they became final.
    """
    for agent in agents:
        agent.begin_planning(now)
    sent: set[int] = set()
    proposed: dict[int, Plan] = {}

    def send(final: Collection[int]) -> None:
        for robot in final:
            if robot not in sent:
                sent.add(robot)
                agents[robot].send_plan(now, number)

    def plan_of(robot: int, final: dict[int, Plan]) -> Plan:
        send(final)
        agent = agents[robot]
        agent.listen(now + options.plan_slack * len(final))
        peers = _peer_trajectories(agents, robot, final, proposed, coordination, options)
        proposed[robot] = agent.propose(now, final, peers)
        return proposed[robot]

    plans = coordination.coordinate(range(len(agents)), plan_of, generator)
    for robot in plans:
        agents[robot].follow()
    send(plans)
    for agent in agents:
        agent.send_views(now)
    return plans


def plan_alone(agent: Agent, options: TeamOptions, now: float, number: int) -> None:
    """Makes and follows the next plan of a robot whose teammates run in other processes.

    The robot avoids the paths of the plans that it has heard, and discounts the views of those heard in the
    last planning period.
    """
    agent.begin_planning(now)
    heard = agent.robot.plans
    step = options.dynamics.step
    paths = [
        predicted_path(plan, now - agent.heard_at[peer], step)
        for peer, plan in sorted(heard.items())
        if len(plan.path)
    ]
    agent.propose(
        now,
        list(heard),
        PeerTrajectories.of(paths, options.separation),
        since=now - options.dynamics.duration,
    )
    agent.follow()
    agent.send_plan(now, number)
    agent.send_views(now)


def _peer_trajectories(
    agents: Sequence[Agent],
    robot: int,
    final: Mapping[int, Plan],
    proposed: Mapping[int, Plan],
    coordination: Coordination,
    options: TeamOptions,
) -> PeerTrajectories:
    """Where the other robots may be: on their final or proposed plan, and braking if that may change."""
    stays_final = coordination.name != "distributed_greedy"
    paths = []
    for other in agents:
        if other.number == robot:
            continue
        plan = final.get(other.number, proposed.get(other.number))
        if plan is not None:
            paths.append(torch.cat([plan.path, plan.braking])[:, :3])
        if plan is None or not (stays_final or other.number in final):
            paths.append(other.robot.braking[:, :3])
    return PeerTrajectories.of(paths, options.separation)
