// Gazebo's physics behind a few C functions, for ctypes: one world from an SDF text, with one model
// whose joints, in the order of the text, have one degree of freedom each.

#include <chrono>
#include <cstddef>
#include <cstdio>
#include <memory>
#include <string>
#include <vector>

#include <ignition/physics/ForwardStep.hh>
#include <ignition/physics/GetEntities.hh>
#include <ignition/physics/Joint.hh>
#include <ignition/physics/RequestEngine.hh>
#include <ignition/physics/sdf/ConstructJoint.hh>
#include <ignition/physics/sdf/ConstructLink.hh>
#include <ignition/physics/sdf/ConstructModel.hh>
#include <ignition/physics/sdf/ConstructWorld.hh>
#include <ignition/plugin/Loader.hh>
#include <sdf/Root.hh>
#include <sdf/World.hh>

namespace physics = ignition::physics;

using Features = physics::FeatureList<
    physics::ForwardStep, physics::GetEngineInfo, physics::GetModelFromWorld,
    physics::GetJointFromModel, physics::GetBasicJointState, physics::SetBasicJointState, physics::GetBasicJointProperties,
    physics::sdf::ConstructSdfWorld, physics::sdf::ConstructSdfModel,
    physics::sdf::ConstructSdfLink, physics::sdf::ConstructSdfJoint>;

struct Simulation {
  ignition::plugin::Loader loader;
  physics::Engine3dPtr<Features> engine;
  physics::World3dPtr<Features> world;
  std::vector<physics::Joint3dPtr<Features>> joints;
  std::chrono::steady_clock::duration step;
};

namespace {

std::string open(Simulation& simulation, const char* plugin, const char* text, long nanoseconds) {
  const auto names = simulation.loader.LoadLib(plugin);
  if (names.empty()) return std::string("cannot load ") + plugin;
  const auto instance = simulation.loader.Instantiate(*names.begin());
  simulation.engine = physics::RequestEngine<physics::FeaturePolicy3d, Features>::From(instance);
  if (!simulation.engine) return std::string(plugin) + " lacks a feature";
  sdf::Root root;
  for (const auto& error : root.LoadSdfString(text)) return error.Message();
  if (root.WorldCount() != 1) return "the SDF text holds no world";
  simulation.world = simulation.engine->ConstructWorld(*root.WorldByIndex(0));
  if (!simulation.world || simulation.world->GetModelCount() != 1)
    return "the world cannot be built, or has not one model";
  const auto model = simulation.world->GetModel(0);
  for (std::size_t i = 0; i < model->GetJointCount(); ++i) {
    simulation.joints.push_back(model->GetJoint(i));
    if (simulation.joints.back()->GetDegreesOfFreedom() != 1)
      return "a joint has not one degree of freedom";
  }
  simulation.step = std::chrono::nanoseconds(nanoseconds);
  return "";
}

}  // namespace

extern "C" {

// Returns null where that fails; `error` then says why.
Simulation* misstep_open(const char* plugin, const char* text, long nanoseconds, char* error,
                         std::size_t size) {
  auto simulation = std::make_unique<Simulation>();
  std::string message;
  try {
    message = open(*simulation, plugin, text, nanoseconds);
  } catch (const std::exception& exception) {
    message = exception.what();
  }
  if (message.empty()) return simulation.release();
  std::snprintf(error, size, "%s", message.c_str());
  return nullptr;
}

void misstep_close(Simulation* simulation) { delete simulation; }

std::size_t misstep_joint_count(const Simulation* simulation) { return simulation->joints.size(); }

void misstep_set_state(Simulation* simulation, const double* positions, const double* velocities) {
  for (std::size_t i = 0; i < simulation->joints.size(); ++i) {
    simulation->joints[i]->SetPosition(0, positions[i]);
    simulation->joints[i]->SetVelocity(0, velocities[i]);
  }
}

void misstep_get_state(const Simulation* simulation, double* positions, double* velocities) {
  for (std::size_t i = 0; i < simulation->joints.size(); ++i) {
    positions[i] = simulation->joints[i]->GetPosition(0);
    velocities[i] = simulation->joints[i]->GetVelocity(0);
  }
}

void misstep_step(Simulation* simulation, const double* efforts, std::size_t steps) {
  physics::ForwardStep::Output output;
  physics::ForwardStep::State state;
  physics::ForwardStep::Input input;
  input.Get<std::chrono::steady_clock::duration>() = simulation->step;
  for (std::size_t step = 0; step < steps; ++step) {
    // The engine forgets an effort after each step.
    for (std::size_t i = 0; i < simulation->joints.size(); ++i)
      simulation->joints[i]->SetForce(0, efforts[i]);
    simulation->world->Step(output, state, input);
  }
}
}
