"""The machine: what it has and refuses, where files lie and are whole, processes and their ends; notices."""
