// In place of ROS 2's header: plugins are not registered where classes are compiled in.
#define PLUGINLIB_EXPORT_CLASS(...)
