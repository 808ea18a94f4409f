"""Motion capture systems that tell where the car is: VICON, others, recorded ones."""
