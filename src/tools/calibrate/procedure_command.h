// SPDX-License-Identifier: Apache-2.0
/// @file `calibrate --procedure`: the thesis' own ways to a lens.
#pragma once

#include <string>
#include <vector>

#include "tools/calibrate/calibration_arguments.h"

namespace omnister::tools {

struct ProcedureArguments {
  std::string name;  ///< lines, dots or quadric; empty: none of them
  std::string center;
  std::string sweep;
  std::vector<std::string> rois;
};

/// `--procedure`, `--center`, `--sweep`, `--roi`.
void addProcedureArguments(CLI::App& command, ProcedureArguments& arguments);

/// Runs the procedure and prints its result. @throws CLI::ValidationError for wrong usage
void runProcedure(const ProcedureArguments& arguments, const CalibrationArguments& common,
                  const std::vector<std::string>& images, const std::string& detections_file,
                  const std::string& out, bool json);

}  // namespace omnister::tools
