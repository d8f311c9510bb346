"""The network of shadows, which learns from traced rays: `unirender train-visibility`."""
