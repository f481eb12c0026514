"""The paper's parameter table."""

from __future__ import annotations

from sb3_saf.networks.actor import PolicyPool
from sb3_saf.parameters import count, format_table, paper_policy, parameter_table
from sb3_saf.policies import saf
from sb3_saf.policies.saf import SAFCritic


def test_safs_projections_and_knowledge_source() -> None:
    policy = paper_policy(saf.DECLARATION)
    critic, pool = policy.value_net, policy.actor
    assert isinstance(critic, SAFCritic) and isinstance(pool, PolicyPool)
    assert count(critic.message_net) == count(critic.state_net) == count(pool.query_net) == 33_088
    assert count(critic.combine_net) == 41_280
    assert count(critic.knowledge_source) == 76_096 + 16_704
    assert pool.signature_keys.numel() == 256
    assert count(pool.policies) == 4 * 25_735


def test_the_table_has_the_published_numbers_and_the_account_of_the_difference() -> None:
    lines = [line.split() for line in format_table(parameter_table()).splitlines()]
    assert lines[1][:2] == ["CNN", "1,233,056"]
    assert lines[2][:4] == ["IPPO", "1,740,016", "1,740,016", "0"]
    assert lines[3][:4] == ["MAPPO", "2,477,296", "2,477,296", "0"]
    assert lines[4][:4] == ["SAF", "2,556,486", "2,698,342", "-141,856"]
    assert lines[-1][0] == "2,556,486"
    assert lines[-1][-1] == "2,698,342"
