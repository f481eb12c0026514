"""From environments to the rows that policies read: vector environments, the joint observation, the monitor."""
