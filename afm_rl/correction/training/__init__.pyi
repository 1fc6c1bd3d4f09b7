from .paper import train_flow as train_flow
