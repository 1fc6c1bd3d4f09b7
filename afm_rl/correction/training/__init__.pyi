from .prior import draw_examples as draw_examples
from .refine import CFMLoss as CFMLoss, train_flow as train_flow
