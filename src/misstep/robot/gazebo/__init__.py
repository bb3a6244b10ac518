"""Gazebo's own physics (ignition-physics with DART), on a model that Gazebo itself can load.

`misstep.robot.gazebo.build` compiles what stands between Python and Gazebo's C++ libraries, on
demand; `misstep.robot.gazebo.cart_pole` is the cart-pole on it.
"""
