// SPDX-License-Identifier: Apache-2.0
/// @file Finds out what doctor.h judges, from the master, topics, parameters, tf, diagnostics and
/// the machine.
#pragma once

#include <ros/ros.h>

#include <functional>
#include <string>

#include "health/doctor.h"

namespace omnister {

struct DoctorOptions {
  std::string camera;    ///< namespace of the stereo node's topics; empty: the first one found
  double seconds = 6.0;  ///< to listen at most; less when a cloud comes
  /// Listen to nothing that would make others work (clouds, images): only graph, diagnostics, tf
  /// and stage.
  bool passive = false;
  /// Of a passive look: asked while it listens; true ends it early.
  std::function<bool()> interrupt;
};

/// Facts of this machine only: what can be told without a master.
DoctorFacts machineFacts();

/// Whether something accepts connections there. @param uri "http://host:port/"
bool answers(const std::string& uri, double seconds = 2.0);

/// Callbacks must be served by other threads meanwhile. Needs a master that answers.
DoctorFacts gatherFacts(const DoctorOptions& options);

}  // namespace omnister
