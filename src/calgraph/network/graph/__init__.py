"""From the pairs of scanners to start poses and clocks of all."""
