"""What a game gives to ``predict``, as rows, and actions of rows as those of the game. Letters: B rows, M choices."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from gymnasium import spaces

from sb3_saf.teams.conversion import AgentConversion, pixels_to_codes
from sb3_saf.teams.rows import ACTION_MASK_KEY, AGENT_KEY, ALL_KEYS, OBS_KEY, TeamSpaces

#: Keys of PettingZoo's observations with masks.
CLASSIC: Final = {"observation", ACTION_MASK_KEY}


class Given(NamedTuple):
    """
    What a game gives some agents, as rows.

    :param rows: entries of the rows
    :param action_masks: (B, M), masks of policies of MaskablePPO whose rows have none
    :param conversions: of the rows' agents; None if rows are the game's
    :param agents: their names; None for one agent without name
    """

    rows: dict[str, np.ndarray]
    action_masks: np.ndarray | None
    conversions: Sequence[AgentConversion] | None
    agents: list[Any] | None

    def act(
        self, predict: Callable[..., tuple[Any, Any]], state: Any, episode_start: Any, deterministic: bool
    ) -> tuple[Any, Any]:
        """
        Act in the game; of observations by agent, actions and state are by agent, too.

        :param predict: acts on rows, as SB3's ``predict``, whose arguments the others are
        """
        agents, memory, starts = self.agents, state, episode_start
        if agents is not None and state:
            blank = tuple(np.zeros_like(part) for part in next(iter(state.values())))
            memory = tuple(np.stack(part) for part in zip(*(state.get(agent, blank) for agent in agents), strict=True))
            starts = np.array([agent not in state for agent in agents])
            if episode_start is not None:
                starts |= np.asarray(episode_start).astype(bool)
        masks = {} if self.action_masks is None else {"action_masks": self.action_masks}
        actions, after = predict(self.rows, memory, starts, deterministic, **masks)
        of_game = list(actions)
        if self.conversions is not None:
            of_game = [one.game_action(action) for one, action in zip(self.conversions, actions, strict=True)]
        if agents is None:
            return of_game[0], after
        if after is not None:
            after = dict(zip(agents, zip(*after, strict=True), strict=True))
        return dict(zip(agents, of_game, strict=True)), after


def given_by_game(team: TeamSpaces, observation: Any, action_masks: Any, takes_masks: bool) -> Given | None:
    """
    Convert what a game gives to rows; see :meth:`sb3_saf.policies.rows.TeamRowsPolicy.predict`.

    :param team: form of the rows
    :param observation: rows, or observations of the game
    :param action_masks: masks in the form of the observation; None for those in observations and infos
    :param takes_masks: whether the policy takes masks
    :return: None for rows
    :raises ValueError: for unknown agents, and observations and masks that are not of the game's form
    """
    infos: Mapping[Any, Any] = {}
    if isinstance(observation, tuple) and len(observation) == 2 and all(isinstance(x, Mapping) for x in observation):
        observation, infos = observation
    names, conversions = team.names, team.conversions
    agents = _agents_in(team, observation)
    if agents is not None:
        masks = [(infos.get(agent) or {}).get(ACTION_MASK_KEY) for agent in agents]
        if isinstance(action_masks, Mapping):
            masks = [action_masks[agent] for agent in agents]
        indices = list(range(len(agents))) if names is None else [names.index(agent) for agent in agents]
        known = indices if names is not None or len(agents) == team.n_agents else None
        kinds = None if conversions is None else [conversions[index] for index in indices]
        return _given(team, [observation[agent] for agent in agents], masks, kinds, known, agents, takes_masks)
    fitting = [] if conversions is None else [i for i, one in enumerate(conversions) if one.fits(observation)]
    if conversions is None or not fitting:
        return None
    kind = conversions[fitting[0]]
    if any(conversions[index] != kind for index in fitting):
        if isinstance(observation, np.ndarray) and observation.shape == team.own_shape:
            return None
        agent = 0 if names is None else names[fitting[0]]
        raise ValueError(
            f"expected to know whose observation this is, which several kinds of agents have; name the agent: "
            f"predict({{{agent!r}: observation}})"
        )
    index = fitting if len(fitting) == 1 else None
    return _given(team, [observation], [action_masks], [kind], index, None, takes_masks)


def _agents_in(team: TeamSpaces, observation: object) -> list[Any] | None:
    """Return the agents of ``{agent: observation}``; None for any other observation."""
    if not isinstance(observation, Mapping) or not observation:
        return None
    agents, names, has_keys = list(observation), team.names, not ALL_KEYS.union(CLASSIC).isdisjoint(observation)
    if names is None and not has_keys and len(agents) > team.n_agents:
        raise ValueError(f"expected observations of at most {team.n_agents} agents, got {len(agents)}")
    if names is None:
        return None if has_keys else agents
    unknown = [agent for agent in agents if agent not in names]
    if not unknown:
        return agents
    if has_keys or any(one.fits(observation) for one in team.conversions or ()):
        return None
    raise ValueError(
        f"expected observations of {', '.join(map(repr, names))}, the agents of the training environment, got "
        f"{unknown[0]!r}"
    )


def _given(
    team: TeamSpaces,
    entries: list[Any],
    masks: list[Any],
    conversions: Sequence[AgentConversion] | None,
    indices: list[int] | None,
    agents: list[Any] | None,
    takes_masks: bool,
) -> Given:
    """Convert observations and masks of some agents; without ``conversions`` they have the form of rows."""
    own: list[np.ndarray] = []
    legal: list[Any] = []
    for number, (entry, mask) in enumerate(zip(entries, masks, strict=True)):
        try:
            if conversions is None:
                has_mask = isinstance(entry, Mapping) and set(entry) == CLASSIC
                own.append(np.asarray(entry["observation"] if has_mask else entry))
                legal.append(entry[ACTION_MASK_KEY] if has_mask and mask is None else mask)
                continue
            conversion = conversions[number]
            observation, mask_of_entry = conversion.split(entry)
            own.append(conversion.own(observation))
            if mask_of_entry is not None and conversion.mask_key is None and not takes_masks:
                raise ValueError(f"expected no {ACTION_MASK_KEY!r}, because this policy was trained without masks")
            legal.append(mask_of_entry if mask is None else mask)
            if team.action_mask is not None or (takes_masks and legal[-1] is not None):
                legal[-1] = conversion.mask(legal[-1])
        except ValueError as error:
            raise ValueError(f"observation of {'the agent' if agents is None else agents[number]}: {error}") from None
    if len(shapes := {array.shape for array in own}) > 1:
        raise ValueError(f"expected observations of one shape, that of rows, {team.own_shape}, got {sorted(shapes)}")
    rows = {OBS_KEY: np.stack(own)} | ({} if indices is None else {AGENT_KEY: np.array(indices)})
    has_masks = takes_masks and all(mask is not None for mask in legal)
    action_masks = np.stack([np.asarray(mask) for mask in legal]) if has_masks else None
    if action_masks is not None and team.action_mask is not None:
        rows, action_masks = {**rows, ACTION_MASK_KEY: action_masks}, None
    return Given(rows, action_masks, conversions, agents)


def own_observations(observation: np.ndarray, space: spaces.Space[Any]) -> np.ndarray:
    """
    Return own observations for ``predict``; a model trained on tile codes also takes the game's pixels.

    :param observation: one or a batch
    :param space: one agent's own observation space
    :raises ValueError: for NaN, and for tile codes that the atlas lacks
    """
    atlas = getattr(space, "atlas", None)
    if atlas is not None:
        height, width = (cells * atlas.shape[1] for cells in space.shape or ())
        if observation.shape[-3:] in ((height, width, atlas.shape[3]), (atlas.shape[3], height, width)):
            observation = pixels_to_codes(observation, atlas).astype(space.dtype)
    if observation.dtype.kind == "f" and not np.isfinite(observation).all():
        raise ValueError(f"{OBS_KEY!r} must be finite, got {observation[~np.isfinite(observation)][0]}")
    if atlas is not None and observation.shape[-2:] == space.shape:
        largest = observation.max(initial=0)
        if observation.min(initial=0) < 0 or largest >= len(atlas):
            raise ValueError(f"{OBS_KEY!r} must be tile codes in 0..{len(atlas) - 1}, got {largest}")
    return observation
