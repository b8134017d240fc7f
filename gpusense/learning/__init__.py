"""Intrinsic parameters of sensor models, learned from data: beam, landmark and discrete model."""
