"""The ground robot on a track: a kinematic model, or four wheels in MuJoCo."""
