"""Networks in SE(3): stationary 3-D LiDARs, from people who walk and from surfaces that stand still."""
