"""The machine file: chains of URDFs, loops, forces, tasks, hydraulics in one YAML."""
