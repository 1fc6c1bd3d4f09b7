from .paper import train_flow as train_flow
from .prior import draw_examples as draw_examples
