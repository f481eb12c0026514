"""The policies of SB3 and sb3-contrib: an algorithm's actor and critic in the form that PPO and others ask for."""
