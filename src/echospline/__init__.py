"""echospline: real-time simulation of ultrasound image deformation under a needle."""
