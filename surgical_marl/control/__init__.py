"""Actions: numbers of an agent become commands of its arm's actuators."""
