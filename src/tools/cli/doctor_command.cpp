// SPDX-License-Identifier: Apache-2.0
// The doctor looks at a running ROS system, which this command line knows nothing of: it becomes
// the node that does (src/ros/doctor/doctor_node.cpp), which stands beside it.
#include <unistd.h>

#include <cerrno>
#include <filesystem>
#include <memory>

#include "omnister/common/error.h"
#include "tools/cli/commands.h"

namespace omnister::tools {
namespace {

namespace fs = std::filesystem;

struct Arguments {
  std::string camera;
  double seconds = 6.0;
};

void run(const Arguments& arguments, bool json) {
  std::error_code error;
  const fs::path self = fs::read_symlink("/proc/self/exe", error);
  const fs::path doctor = self.parent_path() / "doctor_node";
  if (error || !fs::exists(doctor, error))
    throw Error(
        "the doctor's program doctor_node is not beside this one: it is built with ROS only");
  std::vector<std::string> words = {doctor.string(), "--seconds",
                                    std::to_string(arguments.seconds)};
  if (!arguments.camera.empty()) words.insert(words.end(), {"--camera", arguments.camera});
  if (json) words.emplace_back("--json");
  std::vector<char*> argv;
  for (std::string& word : words) argv.push_back(word.data());
  argv.push_back(nullptr);
  ::execv(doctor.c_str(), argv.data());
  throw IoError("start", doctor.string(), errno);
}

}  // namespace

void addDoctor(CLI::App& app) {
  CLI::App* command = app.add_subcommand(
      "doctor", "Why a running rig gives no cloud or drops frames, and how to mend it");
  auto arguments = std::make_shared<Arguments>();
  command->add_option("--camera", arguments->camera,
                      "Namespace of the camera; empty: the first stereo node found");
  command->add_option("--seconds", arguments->seconds, "To listen at most [s]")
      ->check(CLI::Range(0.1, 600.0))
      ->capture_default_str();
  const bool& json = addJsonFlag(*command);
  command->callback([arguments, &json] { run(*arguments, json); });
}

}  // namespace omnister::tools
