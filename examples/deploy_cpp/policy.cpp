// A deployed policy without Python: steps of the graph of `xreset export deploy`, with onnxruntime's C API.
//
//     g++ -std=c++17 policy.cpp -I ORT/include -L ORT/lib -lonnxruntime -o policy
//     ./policy on_robot/policy.onnx STEPS < readings > targets
//
// Standard input has, for each step, the numbers of all inputs but memory_in, in the order of the graph's inputs; a
// robot's program takes them from its sensors. Standard output has one line of joint targets for each step.

#include <onnxruntime_c_api.h>

#include <cstdio>
#include <cstdlib>
#include <string>
#include <vector>

const OrtApi* ort = OrtGetApiBase()->GetApi(14);

void check(OrtStatus* status) {
  if (status == nullptr) return;
  std::fprintf(stderr, "policy: %s\n", ort->GetErrorMessage(status));
  std::exit(1);
}

int main(int count, char** arguments) {
  if (count != 3) {
    std::fprintf(stderr, "usage: policy POLICY.onnx STEPS < readings > targets\n");
    return 2;
  }
  OrtEnv* env;
  OrtSessionOptions* options;
  OrtSession* session;
  OrtAllocator* allocator;
  OrtMemoryInfo* cpu;
  size_t inputs;
  check(ort->CreateEnv(ORT_LOGGING_LEVEL_ERROR, "policy", &env));
  check(ort->CreateSessionOptions(&options));
  check(ort->SetIntraOpNumThreads(options, 1));  // one core, so that the time of a step varies little
  check(ort->CreateSession(env, arguments[1], options, &session));
  check(ort->GetAllocatorWithDefaultOptions(&allocator));
  check(ort->CreateCpuMemoryInfo(OrtArenaAllocator, OrtMemTypeDefault, &cpu));
  check(ort->SessionGetInputCount(session, &inputs));

  std::vector<char*> names(inputs);
  std::vector<std::vector<float>> values(inputs);  // an episode begins with a memory of zeros
  std::vector<OrtValue*> tensors(inputs);
  for (size_t i = 0; i < inputs; i++) {
    OrtTypeInfo* type;
    const OrtTensorTypeAndShapeInfo* info;
    size_t dimensions;
    check(ort->SessionGetInputName(session, i, allocator, &names[i]));
    check(ort->SessionGetInputTypeInfo(session, i, &type));
    check(ort->CastTypeInfoToTensorInfo(type, &info));
    check(ort->GetDimensionsCount(info, &dimensions));
    std::vector<int64_t> shape(dimensions);
    check(ort->GetDimensions(info, shape.data(), dimensions));
    shape[0] = 1;  // one robot
    size_t numbers = 1;
    for (int64_t length : shape) numbers *= length;
    values[i].assign(numbers, 0.0f);
    check(ort->CreateTensorWithDataAsOrtValue(cpu, values[i].data(), numbers * sizeof(float), shape.data(), dimensions,
                                              ONNX_TENSOR_ELEMENT_DATA_TYPE_FLOAT, &tensors[i]));
  }

  const char* outputs[] = {"target", "memory_out"};
  for (int step = 0; step < std::atoi(arguments[2]); step++) {
    std::vector<float>* memory = nullptr;
    for (size_t i = 0; i < inputs; i++) {
      if (names[i] == std::string("memory_in")) memory = &values[i];
      else for (float& value : values[i]) if (std::scanf("%f", &value) != 1) {
        std::fprintf(stderr, "policy: the readings end, or are no number, at %s of step %d\n", names[i], step);
        return 1;
      }
    }
    OrtValue* results[] = {nullptr, nullptr};
    float* numbers[2];
    check(ort->Run(session, nullptr, names.data(), tensors.data(), inputs, outputs, 2, results));
    for (int i = 0; i < 2; i++) check(ort->GetTensorMutableData(results[i], reinterpret_cast<void**>(&numbers[i])));
    OrtTensorTypeAndShapeInfo* info;
    size_t joints;
    check(ort->GetTensorTypeAndShape(results[0], &info));
    check(ort->GetTensorShapeElementCount(info, &joints));
    for (size_t j = 0; j < joints; j++) std::printf("%.9g%c", numbers[0][j], j + 1 < joints ? ' ' : '\n');
    memory->assign(numbers[1], numbers[1] + memory->size());
    ort->ReleaseTensorTypeAndShapeInfo(info);
    for (OrtValue* result : results) ort->ReleaseValue(result);
  }
}
