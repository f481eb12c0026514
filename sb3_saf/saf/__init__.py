"""SAF: a knowledge source for the critic, a pool of policies for the actor."""
