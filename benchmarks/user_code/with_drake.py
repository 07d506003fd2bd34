"""Drake: the URDF in a discrete plant, a ball constraint closes the loop."""

import logging
from pathlib import Path

import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import DiscreteContactApproximation, MultibodyPlant
from pydrake.systems.analysis import Simulator

logging.getLogger("drake").setLevel(logging.ERROR)
plant = MultibodyPlant(1e-3)
plant.set_discrete_contact_approximation(DiscreteContactApproximation.kSap)
Parser(plant).AddModels(str(Path(__file__).with_name("four_bar.urdf")))
plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base"))
coupler, rocker = plant.GetBodyByName("coupler"), plant.GetBodyByName("rocker")
plant.AddBallConstraint(coupler, np.array([0.7, 0, -0.2]), rocker, np.array([0.1, 0, -0.5]))
plant.Finalize()
simulator = Simulator(plant)
simulator.AdvanceTo(1.0)
pose = plant.EvalBodyPoseInWorld(simulator.get_context(), rocker)
print(*pose.multiply(np.array([0.1, 0, -0.5])))
