"""Policies that see pictures instead of the object's state: cameras, encoders, imitation, and the derived task for online RL.

    cameras.py    what a task's cameras look at, and which numbers of the state observation stay beside the pictures
    mujoco_eyes.py, sapien_eyes.py   drawing them, without changing what is simulated
    sim.py        a simulation that shows pictures
    encoders.py   PlainConv, random shift, a frozen encoder on disk
    pictures.py   the pictures along demonstrations, drawn by replaying them
    learn.py      encoder and policy trained together on demonstrations
    task.py       the derived task: features of the frozen encoder and the robot's state as a flat observation
"""
