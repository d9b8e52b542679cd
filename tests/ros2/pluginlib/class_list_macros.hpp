// A stand-in for tests: the plug-in is made by a function of the program that loads it.
#pragma once

#define PLUGINLIB_EXPORT_CLASS(Class, Base) \
    std::unique_ptr<Base> make_plugin() { return std::make_unique<Class>(); }
