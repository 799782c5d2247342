//! Goal-Conditioned Transporter Networks in libtorch: networks, losses, augmentation, checkpoints.
